"""Verdicts over libraries of effects too large to sample each: linear evidence.

Here lives what one Jacobian says of all effects, which of them are fitted, and the
verdict where fits and their linear evidence are all there is. How a model is fitted and
what errors there are is found on the floors below.
"""

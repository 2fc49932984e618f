"""Models of the noise of a measurement, and their estimation from repeats.

This package contains densities of x given its mean. It does not contain the simulators
that give the mean.
"""

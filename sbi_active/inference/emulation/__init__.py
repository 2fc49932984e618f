"""Likelihoods learned from few simulations, which all trials and rounds share.

Here live a pool of simulations and Gaussian processes on them. The loop that asks for
more, samples and judges is that of ``refinement``.
"""

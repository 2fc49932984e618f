"""Refinement: the posterior of all trials, by simulations where it is.

Here live its stages, its beliefs, and how far to trust them. No network is asked.
"""

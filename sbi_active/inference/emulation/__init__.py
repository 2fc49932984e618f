"""Likelihoods learned from simulations: one pool, one loop, two ways to regress.

Here live the pool, regressions, interpolations, the loop that asks for more, and how
far to trust its beliefs. No network is asked.
"""

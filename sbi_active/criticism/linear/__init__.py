"""Models linear at their best fits: the fits, their evidence, what is left out.

Here live linearizations, and the errors that all models share: white noise beside a
process, whitened by Kalman filters. What is concluded from them lives in ``misfit``,
and a belief about one model in ``identification``.
"""

"""Models linear at their best fits: the fits, their evidence, what is left out.

This package contains linearizations, and the errors that all models share: white noise
plus a process, whitened by Kalman filters. The conclusions from them are in ``misfit``,
and a belief about one model in ``identification``.
"""

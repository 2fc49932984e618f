"""Models linear at their best fits: the fits, their evidence, what is left out.

Here live linearizations and the errors that all models share. What is concluded from
them lives in ``misfit``.
"""

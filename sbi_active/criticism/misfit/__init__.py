"""Verdicts when every model is wrong: one evidence, left-out trials, what remains.

Here live linearized models, the errors that all of them share, and the rule that says
what helps and what is named. What samples a posterior lives in ``evidence``.
"""

from sbi_active.criticism.misfit.verdict import find_misfit

__all__ = ["find_misfit"]

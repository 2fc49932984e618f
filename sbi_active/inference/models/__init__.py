"""Learned models as functions of parameters, outcome and action.

This package contains posteriors, likelihoods and ratios. Beliefs, which have seen a
trial, are in ``beliefs``.
"""

from sbi_active.inference.models.factors import ActionLikelihood, ActionRatio

__all__ = ["ActionLikelihood", "ActionRatio"]

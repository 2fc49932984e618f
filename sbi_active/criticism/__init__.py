"""The closed loop: find the residual, trace it to an effect, add it, report."""

from sbi_active.criticism.criticism import Criticism, close_loop
from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.effects.augmented import AugmentedSimulator
from sbi_active.criticism.effects.effect import Context, Effect
from sbi_active.criticism.effects.generic import generic_effects
from sbi_active.criticism.effects.joint_prior import JointPrior, joint_prior
from sbi_active.criticism.report.report import Report
from sbi_active.criticism.results import (
    Detection,
    Estimate,
    Evaluation,
    Evidence,
    NextAction,
    Residuals,
    SevereTest,
    Tracing,
)

__all__ = [
    "AugmentedSimulator",
    "Context",
    "Criticism",
    "Detection",
    "Effect",
    "Estimate",
    "Evaluation",
    "Evidence",
    "JointPrior",
    "NextAction",
    "Report",
    "Residuals",
    "SevereTest",
    "Tracing",
    "Trials",
    "close_loop",
    "generic_effects",
    "joint_prior",
]

"""The closed loop: find the residual, trace it to an effect, add it, report.

This package contains what a user calls and declares; its parts are in the packages
below. It does not depend on campaigns.
"""

from sbi_active.criticism.criticism import Criticism
from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.effects.augmented import AugmentedSimulator
from sbi_active.criticism.effects.effect import Context, Effect
from sbi_active.criticism.effects.first_samples import start_from_first_samples
from sbi_active.criticism.effects.generic import generic_effects, varying_parameters
from sbi_active.criticism.effects.joint_prior import joint_prior
from sbi_active.criticism.identification.identify import identify
from sbi_active.criticism.loop import close_loop
from sbi_active.criticism.report.report import Report
from sbi_active.renamed import former_names

__all__ = [
    "AugmentedSimulator",
    "Context",
    "Criticism",
    "Effect",
    "Report",
    "Trials",
    "close_loop",
    "generic_effects",
    "identify",
    "joint_prior",
    "start_from_first_samples",
    "varying_parameters",
]

__getattr__ = former_names(__name__)

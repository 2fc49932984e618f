"""The steps of the loop, one a module: detect, trace, combine, predict, evaluate.

This package contains functions of rivals and trials that return a result. The texts
about results are in ``report``, proposals of trials in ``next_trial``.
"""

from sbi_active.criticism.steps.detection import LEVEL, num_determined
from sbi_active.criticism.steps.influence import (
    is_left_to_chance,
    unless_refuted,
    withdrawn,
)
from sbi_active.criticism.steps.leave_one_out import LeaveOneOut
from sbi_active.criticism.steps.predictive import predict

__all__ = [
    "LEVEL",
    "LeaveOneOut",
    "is_left_to_chance",
    "num_determined",
    "predict",
    "unless_refuted",
    "withdrawn",
]

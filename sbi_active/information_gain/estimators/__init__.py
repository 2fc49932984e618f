"""Estimators of the expected information gain, one a module.

This package contains the estimators that a designer can be given, and the choice among
them. The fits that they rest on are in ``fits``.
"""

from sbi_active.information_gain.estimators.automatic import (
    ESTIMATORS,
    choose_estimator,
    disagreements,
)
from sbi_active.information_gain.estimators.entropy import with_control
from sbi_active.information_gain.estimators.parameters import NormalScores

__all__ = [
    "ESTIMATORS",
    "NormalScores",
    "choose_estimator",
    "disagreements",
    "with_control",
]

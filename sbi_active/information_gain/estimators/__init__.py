"""Estimators of the expected information gain, one a module.

Here live those that a designer can be given, and what chooses among them. The fits they
rest on live in ``fits``.
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

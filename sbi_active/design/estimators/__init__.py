"""Estimators of the expected information gain, and what they rest on.

This package estimates the worth of a trial of an action from outcomes of it, in nats.
It simulates nothing and chooses no action; ``design`` does.
"""

from sbi_active.design.estimators.automatic import ESTIMATORS, choose_estimator
from sbi_active.design.estimators.base import (
    CandidateSimulations,
    InformationGainEstimator,
)

__all__ = [
    "ESTIMATORS",
    "CandidateSimulations",
    "InformationGainEstimator",
    "choose_estimator",
]

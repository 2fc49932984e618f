"""Can a posterior be trusted, given the action and around a belief?

This package judges networks and beliefs by fresh simulations, with sbi's own tools, and
reports the result in words. It does not make beliefs, and does not use them further.
"""

from sbi_active.diagnostics.beliefs import BeliefCheck, check_belief
from sbi_active.diagnostics.calibration import Calibration, Stratum
from sbi_active.diagnostics.check import check_calibration

__all__ = [
    "BeliefCheck",
    "Calibration",
    "Stratum",
    "check_belief",
    "check_calibration",
]

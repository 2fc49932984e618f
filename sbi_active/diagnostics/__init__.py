"""Can a posterior be trusted, given the action and around a belief?

Here lives what judges networks and beliefs by fresh simulations, with sbi's own tools,
and says so in words. How a belief is made does not, nor what it is used for.
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

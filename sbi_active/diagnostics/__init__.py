"""Can a posterior be trusted, given the action and around a belief?

This package judges networks and beliefs by fresh simulations, with sbi's own tools, and
reports the result in words. It does not make beliefs, and does not use them further.
"""

from sbi_active.diagnostics.beliefs import check_belief
from sbi_active.diagnostics.check import check_calibration
from sbi_active.renamed import former_names

__all__ = ["check_belief", "check_calibration"]

__getattr__ = former_names(__name__)

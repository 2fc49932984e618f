"""Refinement: the posterior of all trials, by simulations where it is.

Here live its stages, its beliefs, and how far to trust them. No network is asked.
"""

from sbi_active.inference.refinement.learned_belief import LearnedBelief
from sbi_active.inference.refinement.outcome_checks import BLURRED
from sbi_active.inference.refinement.regression_error import (
    LARGE,
    expected_error,
    widened,
)

__all__ = [
    "BLURRED",
    "LARGE",
    "LearnedBelief",
    "expected_error",
    "widened",
]

"""Refinement: the posterior of all trials, by simulations where it is.

Here live its stages, its beliefs, and how far to trust them. No network is asked.
"""

from sbi_active.inference.refinement.importance import importance_sample
from sbi_active.inference.refinement.learned_belief import LearnedBelief
from sbi_active.inference.refinement.outcome_checks import BLURRED
from sbi_active.inference.refinement.regression_error import (
    LARGE,
    expected_error,
    widened,
)
from sbi_active.inference.refinement.simulated_belief import SimulatedBelief
from sbi_active.inference.refinement.simulated_likelihood import (
    MeanTable,
    SimulatedLikelihood,
    declares_noise,
)

__all__ = [
    "BLURRED",
    "SimulatedBelief",
    "LARGE",
    "MeanTable",
    "LearnedBelief",
    "SimulatedLikelihood",
    "declares_noise",
    "expected_error",
    "importance_sample",
    "widened",
]

"""A rival: one simulator with some effects and an error, and its density of trials.

This package contains the coordinates, outcomes and errors of a rival. The comparison of
rivals is in ``evidence``.
"""

from sbi_active.criticism.rivals.error_models import NoiseCell, NoiseGrid
from sbi_active.criticism.rivals.noise_grid import declared_noise
from sbi_active.criticism.rivals.residual_process import ResidualProcess
from sbi_active.criticism.rivals.trial_simulator import NUM_REPLICATES, TrialSimulator
from sbi_active.criticism.rivals.validity import (
    DISAGREEMENT,
    UNKNOWN_RATES,
    log_outcomes,
)

__all__ = [
    "DISAGREEMENT",
    "NUM_REPLICATES",
    "NoiseCell",
    "NoiseGrid",
    "ResidualProcess",
    "TrialSimulator",
    "UNKNOWN_RATES",
    "declared_noise",
    "log_outcomes",
]

"""Rows of a round: simulations, what they are conditioned on, what sbi is given.

This package contains the shapes and checks that all trainers share. It does not learn.
"""

from sbi_active.inference.rounds.condition import (
    action_rows,
    outcome_rows,
    pack,
    unpack,
)
from sbi_active.inference.rounds.rows import UnexplainedOutcomeError
from sbi_active.inference.rounds.tracking import SilentTracker

__all__ = [
    "SilentTracker",
    "UnexplainedOutcomeError",
    "action_rows",
    "outcome_rows",
    "pack",
    "unpack",
]

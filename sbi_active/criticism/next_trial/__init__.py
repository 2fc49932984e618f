"""The next trial: the action that tells rivals apart, and the severest test.

This package proposes a trial. The conclusions from trials are in ``steps``.
"""

from sbi_active.criticism.next_trial.candidates import (
    extrapolated,
    following,
    outside_candidates,
)
from sbi_active.criticism.next_trial.next_action import PredictedRival, choose_action

__all__ = [
    "PredictedRival",
    "choose_action",
    "extrapolated",
    "following",
    "outside_candidates",
]

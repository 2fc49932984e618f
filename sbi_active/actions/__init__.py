"""Action spaces: what the robot may do in the next trial, one kind a file.

This package contains the spaces alone. The choice of an action is in ``design``.
"""

from sbi_active.actions.box import BoxActions
from sbi_active.actions.discrete import DiscreteActions
from sbi_active.actions.mixed import MixedActions
from sbi_active.actions.signals import SignalActions
from sbi_active.actions.space import ActionSpace
from sbi_active.actions.summaries import SummaryAction

__all__ = [
    "ActionSpace",
    "BoxActions",
    "DiscreteActions",
    "MixedActions",
    "SignalActions",
    "SummaryAction",
]

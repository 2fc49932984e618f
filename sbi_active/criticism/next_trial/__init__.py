"""The next trial: the action that tells rivals apart, and the severest test.

This package proposes a trial. The conclusions from trials are in ``steps``.
"""

from sbi_active.criticism.next_trial.next_action import choose_action

__all__ = ["choose_action"]

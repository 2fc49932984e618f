"""Checks of a campaign's trials against what was believed before them.

This package contains the scores, the surprises and the health computed from them. It
does not contain what a campaign does about them.
"""

from sbi_active.campaign.checks.health import assess, log_e_value
from sbi_active.campaign.checks.score import score_outcome
from sbi_active.campaign.checks.unexplained import outlyingness
from sbi_active.campaign.checks.unlike import most_unlike

__all__ = ["assess", "log_e_value", "most_unlike", "outlyingness", "score_outcome"]

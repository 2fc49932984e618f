"""The loop around a real experiment: ask for an action, tell the outcome, go on.

This package contains the course of a campaign: its state, its rules and its checks. The
code that learns, designs or criticizes is in the packages it calls. Names are imported
when they are used, so that reading the log of the trials needs no torch.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from sbi_active.renamed import lazy_names

if TYPE_CHECKING:
    from sbi_active.campaign.campaign import Campaign
    from sbi_active.campaign.options import CampaignOptions, StopRules
    from sbi_active.campaign.state import Trial

__all__ = ["Campaign", "CampaignOptions", "StopRules", "Trial"]

__getattr__ = lazy_names(__name__)

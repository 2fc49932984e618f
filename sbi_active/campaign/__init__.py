"""The loop around a real experiment: ask for an action, tell the outcome, go on."""

from sbi_active.campaign.campaign import Campaign
from sbi_active.campaign.state import (
    CampaignOptions,
    CampaignState,
    ModelVersion,
    Trial,
)
from sbi_active.campaign.stopping import StopRules

__all__ = [
    "Campaign",
    "CampaignOptions",
    "CampaignState",
    "ModelVersion",
    "StopRules",
    "Trial",
]

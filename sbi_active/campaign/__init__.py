"""The loop around a real experiment: ask for an action, tell the outcome, go on."""

from sbi_active.campaign.campaign import Campaign
from sbi_active.campaign.state import (
    CampaignOptions,
    CampaignState,
    ModelVersion,
    Trial,
)

__all__ = ["Campaign", "CampaignOptions", "CampaignState", "ModelVersion", "Trial"]

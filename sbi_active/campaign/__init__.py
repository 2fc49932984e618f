"""The loop around a real experiment: ask for an action, tell the outcome, go on.

Here lives the course of a campaign: its state, its rules and its checks. What learns,
designs or criticizes lives in the packages it calls.
"""

from sbi_active.campaign.campaign import Campaign
from sbi_active.campaign.options import CampaignOptions
from sbi_active.campaign.state import Trial
from sbi_active.campaign.stopping import StopRules
from sbi_active.renamed import former_names

__all__ = ["Campaign", "CampaignOptions", "StopRules", "Trial"]

__getattr__ = former_names(
    __name__,
    {
        "CampaignState": "sbi_active.campaign.state:CampaignState",
        "ModelVersion": "sbi_active.campaign.state:ModelVersion",
    },
)

"""A campaign on disk: what it is, what happened, and what was computed from it.

Here live files, their checks, and the way back. Nothing here infers or designs.
"""

from sbi_active.campaign.storage.damage import DamagedCampaignError

__all__ = ["DamagedCampaignError"]

"""The error of a campaign's files that are not what was written."""

from __future__ import annotations

from pathlib import Path

from sbi_active.messages import Explained


class DamagedCampaignError(Explained, OSError):
    """A file of a campaign that does not hold what was written to it.

    Attributes:
        path: The file.
        reason: What is wrong with it, and what is whole.
    """

    def __init__(self, path: Path, reason: str) -> None:
        self.path, self.reason = path, reason
        super().__init__(
            f"expected {path} as it was written; got {reason}; restore it from a copy, "
            "or load the campaign with repair=True, which gives up what is damaged, "
            "keeps a copy and names what has to be told again"
        )

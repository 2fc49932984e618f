"""The error of a campaign's file that is not what was written."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sbi_active.messages import Explained
from sbi_active.simulation.bank.damage import CorruptSegmentError


class DamagedCampaignError(Explained, OSError):
    """A file of a campaign that does not hold what was written to it.

    Attributes:
        path: The file.
        reason: Text that says what is damaged, and what is whole.
    """

    code = "SA606"

    def __init__(self, path: Path, reason: str) -> None:
        self.path, self.reason = path, reason
        super().__init__(
            f"expected {path} as it was written; got {reason}; restore it from a copy, "
            "or load the campaign with repair=True, which gives up what is damaged, "
            "keeps a copy and names what has to be told again"
        )


class LogChangedError(Explained, ValueError):
    """Another writer added to a campaign since it was loaded here.

    Attributes:
        path: The file.
    """

    code = "SA607"

    def __init__(self, path: Path) -> None:
        self.path = path
        super().__init__(
            f"expected the campaign in {path.parent} as it was loaded; got trials that "
            "another process told since; load it again, and tell this once more: "
            "nothing was written"
        )


@contextmanager
def naming() -> Iterator[None]:
    """Turn damage of the store into damage of the campaign.

    Raises:
        DamagedCampaignError: If a bank raises an error.
    """
    try:
        yield
    except CorruptSegmentError as error:
        raise DamagedCampaignError(error.path, error.reason) from error


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Turn what fails while a file is read and made sense of into damage of the file.

    Args:
        path: The file.

    Raises:
        DamagedCampaignError: If any other error is raised, which names no file.
    """
    try:
        with naming():
            yield
    except OSError:
        raise
    except Exception as error:  # what a crafted file leads to has no end
        raise DamagedCampaignError(
            path, f"content that leads to {type(error).__name__}: {str(error):.200}"
        ) from error

"""Progress of a campaign: a bar and a log say what it does and how long it takes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from sbi_active.campaign.state import CampaignState
from sbi_active.progress import News, is_asked_for


class StageWatch:
    """Tells of each stage of a campaign while it runs.

    The duration of a stage is estimated from the same stage of the trial before.

    Args:
        show_progress: Whether to draw a bar.
    """

    def __init__(self, show_progress: bool = False) -> None:
        self.show_progress = show_progress

    @contextmanager
    def __call__(self, state: CampaignState, index: int, name: str) -> Iterator[None]:
        """Show progress while the block runs.

        Args:
            state: State of the campaign.
            index: Index of the trial that the work is for; of the next one where it is
                for none.
            name: Name of the work.
        """
        if not is_asked_for(self.show_progress):
            yield
            return
        what = f"trial {index}: {name}" if index < len(state.trials) else name
        expected, before = _expected(state, index, name)
        has_bar = self.show_progress
        with News(what, expected=expected, before=before, has_bar=has_bar).told():
            yield


def rounds(state: CampaignState, num_rounds: int) -> Iterator[int]:
    """Yield the numbers of rounds, with a bar where the campaign shows progress."""
    from tqdm.auto import tqdm

    shown = getattr(state.watch, "show_progress", False)
    yield from tqdm(range(num_rounds), desc="rounds", disable=not shown)


def _expected(state: CampaignState, index: int, name: str) -> tuple[float | None, str]:
    """Return the seconds that a stage took last, and in which trial."""
    for trial in reversed(state.trials[:index]):
        if name in trial.seconds:
            return trial.seconds[name], f"trial {trial.index}"
    return None, ""

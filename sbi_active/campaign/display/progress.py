"""What a campaign is doing and how long it will take: a bar and a log."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from sbi_active.campaign.state import CampaignState

#: Says what takes long; the program that uses the library decides where to.
LOGGER = logging.getLogger("sbi_active")
LOGGER.addHandler(logging.NullHandler())

LONG = 2.0  # seconds from which a stage is worth a line of the log
SHOWN = 0.3  # seconds from which it is worth a bar, which otherwise flickers
TICK = 0.1  # seconds between two looks at the clock


class StageWatch:
    """Tells of each stage of a campaign while it runs.

    How long one takes is known from the same stage of the trial before.

    Args:
        show_progress: Whether to draw a bar.
    """

    def __init__(self, show_progress: bool = False) -> None:
        self.show_progress = show_progress

    @contextmanager
    def __call__(self, state: CampaignState, index: int, name: str) -> Iterator[None]:
        """Tell of the block.

        Args:
            state: Of the campaign.
            index: Of the trial that it is for; of the next one where it is for none.
            name: What it does.
        """
        if not self.show_progress and not LOGGER.isEnabledFor(logging.INFO):
            yield
            return
        what = f"trial {index}: {name}" if index < len(state.trials) else name
        news = _News(what, *_expected(state, index, name), self.show_progress)
        news.begin()
        try:
            yield
        except BaseException:
            news.end("ended with an error after")
            raise
        news.end("took")


def rounds(state: CampaignState, num_rounds: int) -> Iterator[int]:
    """Yield the numbers of rounds, with a bar where the campaign shows progress."""
    from tqdm.auto import tqdm

    shown = getattr(state.watch, "show_progress", False)
    yield from tqdm(range(num_rounds), desc="rounds", disable=not shown)


def _expected(
    state: CampaignState, index: int, name: str
) -> tuple[float | None, int | None]:
    """Return the seconds that a stage took last, and in which trial."""
    for trial in reversed(state.trials[:index]):
        if name in trial.seconds:
            return trial.seconds[name], trial.index
    return None, None


class _News:
    """A bar and a log of one stage, kept up to date by a thread of its own.

    Args:
        what: What is being done.
        expected: Seconds that it took before; None where it is the first.
        before: In which trial.
        has_bar: Whether to draw a bar.
    """

    def __init__(
        self, what: str, expected: float | None, before: int | None, has_bar: bool
    ) -> None:
        self._what, self._expected, self._before = what, expected, before
        self._has_bar = has_bar
        self._bar: Any = None
        self._said = False
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._follow, daemon=True)
        self._start = time.perf_counter()

    def begin(self) -> None:
        """Say how long it will take where that is known to be long."""
        if self._expected is not None and self._expected > LONG:
            self._say(f"about {_time(self._expected)}, as in trial {self._before}")
        self._thread.start()

    def end(self, how: str) -> None:
        """Say how long it took where that was long, and take the bar away."""
        self._over.set()
        self._thread.join()
        if self._bar is not None:
            self._bar.close()
        if self._said:
            LOGGER.info("%s %s %s", self._what, how, _time(self._seconds))

    @property
    def _seconds(self) -> float:
        return time.perf_counter() - self._start

    def _say(self, text: str) -> None:
        self._said = True
        LOGGER.info("%s, %s", self._what, text)

    def _follow(self) -> None:
        while not self._over.wait(TICK):
            seconds = self._seconds
            if seconds > LONG and not self._said:
                self._say(f"{_time(seconds)} so far; {self._outlook()}")
            if self._has_bar and (seconds > SHOWN or self._bar is not None):
                self._draw(seconds)

    def _outlook(self) -> str:
        if self._expected is None:
            return "it is the first, so that nothing tells how long it will take"
        return f"in trial {self._before} it took {_time(self._expected)}"

    def _draw(self, seconds: float) -> None:
        from tqdm.auto import tqdm

        if self._bar is None:
            text = "{desc}: {elapsed}"
            if self._expected is not None:
                text = "{desc}: {percentage:3.0f}%|{bar}| {elapsed}"
                text += f" of about {_time(self._expected)}"
            self._bar = tqdm(
                total=self._expected, desc=self._what, bar_format=text, leave=False
            )
            self._bar.start_t -= seconds  # it began before it was drawn
        limit = seconds if self._expected is None else self._expected
        self._bar.n = min(seconds, limit)
        self._bar.refresh()


def _time(seconds: float) -> str:
    """Return a time in words.

    Example:
        >>> _time(0.84), _time(12.3), _time(754.0), _time(8000.0)
        ('0.8 s', '12 s', '13 min', '2.2 h')
    """
    if seconds < 100:
        return f"{seconds:.2g} s" if seconds >= 1 else f"{seconds:.1f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"

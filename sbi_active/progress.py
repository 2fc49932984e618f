"""Progress of slow steps: a bar, and lines of a log."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, ClassVar

#: Says what takes long; the program that uses the library decides where to.
LOGGER = logging.getLogger("sbi_active")
LOGGER.addHandler(logging.NullHandler())

#: How many of how many steps, alike in length, are done; None where nobody knows of
#: how many.
Count = Callable[[], tuple[int, int | None]]

_inside = threading.local()


@contextmanager
def stage(
    what: str, *, show_progress: bool = False, count: Count | None = None
) -> Iterator[None]:
    """Report the block while it runs, but no block within it.

    Args:
        what: Name of the work.
        show_progress: Whether to draw a bar.
        count: Steps done, from which the time that is left is estimated.
    """
    asked = show_progress or LOGGER.isEnabledFor(logging.INFO)
    if getattr(_inside, "any", False) or not asked:
        yield
        return
    _inside.any = True
    try:
        with News(what, has_bar=show_progress, count=count).told():
            yield
    finally:
        _inside.any = False


class News:
    """A bar and a log of one stage, kept up to date by a thread of its own.

    Args:
        what: Name of the work.
        has_bar: Whether to draw a bar.
        count: Steps done, from which the seconds that are left are estimated.

    Attributes:
        long: Seconds from which a stage is worth a line of the log.
        shown: Seconds from which it is worth a bar, which otherwise flickers.
        tick: Seconds between two looks at the clock.
        sign: Seconds between two lines of one stage.
    """

    long: ClassVar[float] = 2.0
    shown: ClassVar[float] = 0.3
    tick: ClassVar[float] = 0.1
    sign: ClassVar[float] = 30.0

    def __init__(
        self, what: str, *, has_bar: bool = False, count: Count | None = None
    ) -> None:
        self._what, self._has_bar, self._count = what, has_bar, count
        self._done: tuple[int, int | None] = (0, None)
        self._expected: float | None = None  # seconds in all
        self._bar: Any = None
        self._said_at: float | None = None
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._follow, daemon=True)
        self._start = time.perf_counter()

    @contextmanager
    def told(self) -> Iterator[None]:
        """Report the block."""
        self._thread.start()
        how = "ended with an error after"
        try:
            yield
            how = "took"
        finally:
            self._over.set()
            self._thread.join()
            if self._bar is not None:
                self._bar.close()
            if self._said_at is not None:
                LOGGER.info("%s %s %s", self._what, how, in_words(self._seconds))

    @property
    def _seconds(self) -> float:
        return time.perf_counter() - self._start

    def _follow(self) -> None:
        while not self._over.wait(self.tick):
            seconds = self._seconds
            self._look(seconds)
            due = self.long if self._said_at is None else self._said_at + self.sign
            if seconds > due:
                self._said_at = seconds
                text = f"{in_words(seconds)} so far{self._outlook(seconds)}"
                LOGGER.info("%s, %s", self._what, text)
            if self._has_bar and (seconds > self.shown or self._bar is not None):
                self._draw(seconds)

    def _look(self, seconds: float) -> None:
        """Estimate the time from the steps that were done, as each is."""
        done = (0, None) if self._count is None else self._count()
        if done != self._done:
            self._done, (num, total) = done, done
            self._expected = seconds * total / num if num and total else None

    def _outlook(self, seconds: float) -> str:
        num, total = self._done
        if self._count is None:
            return ""
        steps = f"; {num} done" if total is None else f"; {num} of {total} done"
        if self._expected is None:
            return steps
        return f"{steps}, about {in_words(max(self._expected - seconds, 0))} left"

    def _draw(self, seconds: float) -> None:
        from tqdm.auto import tqdm

        text = "{desc}: {elapsed}"
        if self._expected is not None:
            text = "{desc}: {percentage:3.0f}%|{bar}| {elapsed}"
            text += f" of about {in_words(self._expected)}"
        elif self._done[0]:
            text += f", {self._done[0]} done"
        if self._bar is None:
            self._bar = tqdm(
                total=self._expected, desc=self._what, bar_format=text, leave=False
            )
            self._bar.start_t -= seconds  # it began before it was drawn
        self._bar.bar_format, self._bar.total = text, self._expected
        limit = seconds if self._expected is None else self._expected
        self._bar.n = min(seconds, limit)
        self._bar.refresh()


def in_words(seconds: float) -> str:
    """Return a time in words.

    Example:
        >>> in_words(0.84), in_words(12.3), in_words(754.0), in_words(8000.0)
        ('0.8 s', '12 s', '13 min', '2.2 h')
    """
    if seconds < 100:
        return f"{seconds:.2g} s" if seconds >= 1 else f"{seconds:.1f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"

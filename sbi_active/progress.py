"""Progress of slow steps: a bar, and lines of a log, as tqdm words them."""

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
    news = News(what, has_bar=show_progress, count=count)
    how = "ended with an error after"
    try:
        yield
        how = "took"
    finally:
        _inside.any = False
        news.end(how)


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

    def __init__(self, what: str, *, has_bar: bool, count: Count | None) -> None:
        self._what, self._has_bar, self._count = what, has_bar, count
        self._start, self._over = time.perf_counter(), threading.Event()
        self._thread = threading.Thread(target=self._follow, daemon=True)
        self._thread.start()

    def end(self, how: str) -> None:
        """Take the bar away, and log what took long."""
        seconds = self._seconds
        self._over.set()
        self._thread.join()
        if seconds > self.long:
            LOGGER.info("%s %s %.1f s", self._what, how, seconds)

    @property
    def _seconds(self) -> float:
        return time.perf_counter() - self._start

    def _follow(self) -> None:
        from tqdm.auto import tqdm

        bar: Any = None
        due = self.long
        while not self._over.wait(self.tick):
            seconds = self._seconds
            num, total = (0, None) if self._count is None else self._count()
            form = "{desc}: {elapsed}" if self._count is None else None
            steps: Any = {"n": num, "total": total, "elapsed": seconds}
            text = tqdm.format_meter(**steps, prefix=self._what, bar_format=form)
            if seconds > due:
                due = seconds + self.sign
                LOGGER.info(text)
            if self._has_bar and seconds > self.shown:
                bar = bar or tqdm(total=1, bar_format="{desc}", leave=False)
                bar.set_description_str(text)
        if bar is not None:
            bar.close()

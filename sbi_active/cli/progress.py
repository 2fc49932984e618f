"""What is being done, on standard error, while it takes its time."""

from __future__ import annotations

import sys
import threading
from types import TracebackType

from tqdm import tqdm


class Progress:
    """A bar of rounds that names the present step and goes on counting seconds.

    Args:
        total: Rounds.
        name: In front of the bar.
    """

    #: Seconds between two signs of life: on a terminal, and in a file.
    SIGN, SIGN_IN_FILE = 1.0, 30.0

    def __init__(self, total: int, name: str) -> None:
        self._bar = tqdm(total=total, desc=name, unit="round", mininterval=0)
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._tick, daemon=True)

    def __enter__(self) -> Progress:
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._over.set()
        self._thread.join()
        self._bar.close()

    def step(self, text: str) -> None:
        """Name what is done from now on."""
        self._bar.set_postfix_str(text)

    def count(self) -> None:
        """Count a round."""
        self._bar.update()

    def _tick(self) -> None:
        interval = self.SIGN if sys.stderr.isatty() else self.SIGN_IN_FILE
        while not self._over.wait(interval):
            self._bar.refresh()

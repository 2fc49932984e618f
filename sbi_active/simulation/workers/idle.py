"""Workers that wait for the next simulation of the same simulator."""

from __future__ import annotations

import atexit
import os
import threading
from collections.abc import Sequence

from sbi_active.simulation.workers.processes import Worker


class IdleWorkers:
    """Keeps loaded workers between simulations, so that each is started once.

    They end when a minute has passed, when another simulator comes and when this
    process ends, whichever is first.
    """

    SECONDS = 60.0

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._key = ""
        self._workers: list[Worker] = []
        self._timer: threading.Timer | None = None

    def take(self, key: str) -> list[Worker]:
        """Hand over the workers that wait for this simulator; any others end.

        Args:
            key: Digest of the simulator and its surroundings.
        """
        with self._lock:
            is_same = key == self._key
            self._key = key
            workers = self._withdraw()
        # One that waits has nothing to say, unless it has died.
        useful = [w for w in workers if is_same and not w.connection.poll()]
        _end([w for w in workers if w not in useful])
        return useful

    def give(self, key: str, workers: Sequence[Worker], *, at_most: int) -> None:
        """Let workers wait that have answered all their calls.

        Args:
            key: Digest of the simulator and its surroundings, as for :meth:`take`.
            workers: Loaded with that simulator.
            at_most: Number of them that may wait; the others end.
        """
        with self._lock:
            room = 0
            if key == self._key:  # nobody has come with another one meanwhile
                room = max(at_most - len(self._workers), 0)
                self._workers = self._withdraw() + [*workers[:room]]
                self._timer = threading.Timer(self.SECONDS, self.end, [self._workers])
                self._timer.daemon = True
                self._timer.start()
        _end(workers[room:])

    def end(self, workers: list[Worker] | None = None) -> None:
        """End the workers that wait.

        Args:
            workers: Only if these are they; a timer that is cancelled while it fires
                has nothing to end any more.
        """
        with self._lock:
            if workers is not None and workers is not self._workers:
                return
            workers = self._withdraw()
        _end(workers)

    def _withdraw(self) -> list[Worker]:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        workers, self._workers = self._workers, []
        return workers


def _end(workers: Sequence[Worker]) -> None:
    for worker in workers:
        worker.end()


#: Idle workers of this process.
IDLE = IdleWorkers()

atexit.register(IDLE.end)


def _forget() -> None:
    # A forked child must neither use nor end what belongs to its parent.
    IDLE.__init__()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget)

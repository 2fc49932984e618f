"""Pools that run calls of a simulator, in this process or in worker processes."""

from __future__ import annotations

import hashlib
import os
import pickle
import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from math import inf
from multiprocessing.connection import wait
from typing import Any

from typing_extensions import override

from sbi_active.simulation.workers.calls import Call, Reply, answer
from sbi_active.simulation.workers.idle import IDLE
from sbi_active.simulation.workers.pickling import pickled
from sbi_active.simulation.workers.processes import Worker


class Pool(ABC):
    """Runs calls, some at a time, and hands back what came of them in any order.

    Attributes:
        num_slots: Calls that it takes at once.
        knows_guilty: Whether a call whose worker died was the only one there.
    """

    num_slots: int
    knows_guilty: bool = True

    @property
    @abstractmethod
    def num_free(self) -> int:
        """Calls that it would take now."""

    @abstractmethod
    def submit(self, call: Call, time_limit: float | None) -> None:
        """Take a call.

        Args:
            call: The rows.
            time_limit: Seconds after which it is given up; None waits for ever.
        """

    @abstractmethod
    def collect(self) -> list[tuple[Call, Reply]]:
        """Wait until a call has ended, and return those that have."""

    def close(self) -> None:  # noqa: B027  # most have nothing to close
        """Give up what still runs."""


class InProcess(Pool):
    """Runs each call here, at once."""

    num_slots = 1

    def __init__(self, simulator: Callable[..., Any]) -> None:
        self._simulator = simulator
        self._done: list[tuple[Call, Reply]] = []

    @property
    @override
    def num_free(self) -> int:
        return 1 - len(self._done)

    @override
    def submit(self, call: Call, time_limit: float | None) -> None:
        self._done.append((call, answer(self._simulator, call)))

    @override
    def collect(self) -> list[tuple[Call, Reply]]:
        done, self._done = self._done, []
        return done


class WorkerPool(Pool):
    """Runs calls in processes of its own, each of which has one call at a time.

    A worker that dies or is killed at its time limit therefore loses no other call, and
    the guilty call is known. Workers that have answered are kept for the next pool of
    the same simulator, folder, path and environment.

    Args:
        simulator: Simulator, sent once to each worker.
        num_workers: Number of processes.
    """

    def __init__(self, simulator: Callable[..., Any], num_workers: int) -> None:
        self.num_slots = num_workers
        self._simulator = pickled(simulator)
        surroundings = os.getcwd(), sys.path, dict(os.environ)
        key = pickle.dumps((self._simulator, surroundings))
        self._key = hashlib.sha256(key).hexdigest()
        self._idle = IDLE.take(self._key)
        self._busy: list[Worker] = []

    @property
    @override
    def num_free(self) -> int:
        return self.num_slots - len(self._busy)

    @override
    def submit(self, call: Call, time_limit: float | None) -> None:
        worker = self._idle.pop() if self._idle else Worker(self._simulator)
        self._busy.append(worker)
        worker.start(call, time_limit)

    @override
    def collect(self) -> list[tuple[Call, Reply]]:
        done: list[tuple[Call, Reply]] = []
        while self._busy and not done:
            first = min(w.deadline for w in self._busy)
            timeout = None if first == inf else max(first - time.monotonic(), 0.0)
            wait([w.connection for w in self._busy], timeout=timeout)
            for worker in [*self._busy]:
                reply = worker.reply()
                if reply is not None:
                    self._busy.remove(worker)
                    done.append((worker.call, reply))
                    if reply.fault in ("timed out", "worker died", "not loaded"):
                        worker.end()
                    else:
                        self._idle.append(worker)
        return done

    @override
    def close(self) -> None:
        for worker in self._busy:
            worker.end()
        IDLE.give(self._key, self._idle, at_most=self.num_slots)
        self._idle, self._busy = [], []

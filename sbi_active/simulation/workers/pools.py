"""Pools that run calls of a simulator, in this process or in worker processes."""

from __future__ import annotations

import os
import sys
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import lru_cache
from queue import SimpleQueue
from typing import Any

from typing_extensions import override

from sbi_active.simulation.workers.calls import Call, Reply, answer
from sbi_active.simulation.workers.processes import Worker


class Pool(ABC):
    """Runs calls, some at a time, and hands back what came of them in any order.

    Each call is asked for in a thread of its own, which waits for the reply.

    Args:
        num_slots: Number of calls at a time.
    """

    def __init__(self, num_slots: int) -> None:
        self.num_slots = num_slots
        self._done: SimpleQueue[tuple[Call, Reply | BaseException]] = SimpleQueue()

    @abstractmethod
    def ask(self, call: Call, time_limit: float | None) -> Reply:
        """Return the reply to a call; threads may ask at the same time.

        Args:
            call: The rows.
            time_limit: Seconds after which it is given up; None waits for ever.
        """

    def submit(self, call: Call, time_limit: float | None) -> None:
        """Take a call, with arguments as for :meth:`ask`."""
        thread = threading.Thread(target=self._put, args=(call, time_limit))
        thread.daemon = True
        thread.start()

    def _put(self, call: Call, time_limit: float | None) -> None:
        try:
            reply = self.ask(call, time_limit)
        except BaseException as error:  # collect() raises it
            reply = error
        self._done.put((call, reply))

    def collect(self) -> tuple[Call, Reply]:
        """Wait until a call has ended, and return it with its reply."""
        call, reply = self._done.get()
        if isinstance(reply, BaseException):
            raise reply
        return call, reply

    def close(self) -> None:  # noqa: B027  # most have nothing to close
        """Give up what still runs."""


class InProcess(Pool):
    """Runs each call here, at once.

    Args:
        simulator: Simulator of the calls.
    """

    def __init__(self, simulator: Callable[..., Any]) -> None:
        super().__init__(1)
        self._simulator = simulator

    @override
    def ask(self, call: Call, time_limit: float | None) -> Reply:
        return answer(self._simulator, call)

    @override
    def submit(self, call: Call, time_limit: float | None) -> None:
        self._done.put((call, self.ask(call, time_limit)))


class WorkerPool(Pool):
    """Runs calls in processes, each of which has one call at a time.

    A worker that dies or is killed at its time limit therefore loses no other call, and
    the guilty call is known. Workers that have answered wait for the next pool of the
    same simulator, folder, path and environment.

    Args:
        simulator: Simulator, pickled; it is sent once to each worker.
        num_workers: Number of processes.
    """

    def __init__(self, simulator: bytes, num_workers: int) -> None:
        super().__init__(num_workers)
        self._simulator = simulator
        environment = tuple(sorted(os.environ.items()))
        self._waiting = waiting_workers(
            simulator, os.getpid(), os.getcwd(), tuple(sys.path), environment
        )
        self._busy: set[Worker] = set()
        self._is_closed = False

    @override
    def ask(self, call: Call, time_limit: float | None) -> Reply:
        reply = None
        while reply is None:
            try:
                worker = self._waiting.pop()
            except IndexError:
                worker = Worker(self._simulator)
            self._busy.add(worker)
            if self._is_closed:
                worker.kill()
            reply = worker.ask(call, time_limit)
            self._busy.discard(worker)
        if reply.fault not in ("timed out", "worker died", "not loaded"):
            self._waiting.append(worker)
        return reply

    @override
    def close(self) -> None:
        self._is_closed = True
        for worker in [*self._busy]:
            worker.kill()


@lru_cache(maxsize=1)
def waiting_workers(simulator: bytes, *surroundings: Any) -> list[Worker]:
    """Return the workers that wait for calls of a simulator.

    Those of another simulator end, since nobody holds them any more.

    Args:
        simulator: Simulator, pickled.
        *surroundings: Process, folder, path and environment that they belong to.
    """
    return []

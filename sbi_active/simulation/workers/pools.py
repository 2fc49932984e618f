"""Pools that run calls of a simulator: here, in worker processes, or on Dask."""

from __future__ import annotations

import hashlib
import os
import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import lru_cache
from multiprocessing import current_process
from typing import Any

import cloudpickle
from joblib import effective_n_jobs
from joblib.parallel import get_active_backend
from typing_extensions import override

from sbi_active.messages import warn
from sbi_active.simulation.workers.calls import Call, Reply, answer
from sbi_active.simulation.workers.processes import Worker


class Pool(ABC):
    """Runs calls, some at a time, and hands back what came of them in any order.

    Attributes:
        num_slots: Number of calls at a time.
    """

    #: Seconds between two looks at who is there, where no call ends; None for none.
    LOOK: float | None = None
    #: Exceptions of a reply that say that whoever had the call was lost.
    LOSSES: tuple[type[Exception], ...] = ()
    num_slots = 1

    @abstractmethod
    def submit(self, call: Call, time_limit: float | None) -> Future[Reply]:
        """Return the reply to come of a call.

        Args:
            call: The rows.
            time_limit: Seconds after which it is given up; None waits for ever.
        """

    def look(self, num_waiting: int) -> None:  # noqa: B027
        """See who is there, while so many calls wait."""

    def close(self) -> None:  # noqa: B027  # one has nothing to close
        """Give up what still runs."""


class InProcess(Pool):
    """Runs each call here, at once.

    Args:
        simulator: Simulator of the calls.
    """

    def __init__(self, simulator: Callable[..., Any]) -> None:
        self._simulator = simulator

    @override
    def submit(self, call: Call, time_limit: float | None) -> Future[Reply]:
        future: Future[Reply] = Future()
        future.set_result(answer(self._simulator, call))
        return future


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
        self.num_slots = num_workers
        self._threads = ThreadPoolExecutor(num_workers)
        self._simulator = simulator
        environment = tuple(sorted(os.environ.items()))
        self._waiting = waiting_workers(
            simulator, os.getpid(), os.getcwd(), tuple(sys.path), environment
        )
        self._busy: set[Worker] = set()
        self._is_closed = False

    @override
    def submit(self, call: Call, time_limit: float | None) -> Future[Reply]:
        return self._threads.submit(self.ask, call, time_limit)

    def ask(self, call: Call, time_limit: float | None) -> Reply:
        """Return the reply to a call, for which the thread waits.

        Args:
            call: The rows.
            time_limit: Seconds after which it is given up; None waits for ever.
        """
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
        self._threads.shutdown(wait=False)
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


def configured_client() -> Any:
    """Return the Dask client that ``joblib.parallel_config`` names, or None."""
    backend: Any = get_active_backend()[0]
    is_dask = type(backend).__name__ == "DaskDistributedBackend"
    return backend.client if is_dask else None


class DaskPool(Pool):
    """Runs calls as futures of a Dask client, each in a child of a Dask worker.

    A call that kills its process, or is killed at its time limit, so costs a child,
    which is cheap. The call of a Dask worker that is lost otherwise goes to another.

    A ``LocalCluster`` gives up each worker that is not back 15 s after its death
    (``distributed.deploy.lost-worker-timeout``), for good; those are asked for again.

    Args:
        simulator: Simulator, pickled; it is sent once to each Dask worker.
        num_workers: Number of calls at a time; -1 means one a core of the cluster.
        client: A ``distributed.Client``.
    """

    LOOK = 0.5
    LOSSES = (Exception,)

    #: Seconds without any worker until that is said.
    PATIENCE = 5.0

    def __init__(self, simulator: bytes, num_workers: int, client: Any) -> None:
        num_workers = effective_n_jobs(-1) if num_workers == -1 else num_workers
        self.num_slots = num_workers
        self._executor = client.get_executor(pure=False)
        self._client = client
        key = f"simulator-{hashlib.sha256(simulator).hexdigest()}"
        # A result, not scattered data: what a lost worker held can be made again.
        self._simulator = client.submit(bytes, simulator, key=key)
        self._last_seen: float | None = time.monotonic()  # None once it was said

    @override
    def submit(self, call: Call, time_limit: float | None) -> Future[Reply]:
        return self._executor.submit(_ask_child, self._simulator, call, time_limit)

    @override
    def close(self) -> None:
        self._executor.shutdown(wait=False)

    @override
    def look(self, num_waiting: int) -> None:
        """Say that no worker is there, and ask for those that were given up."""
        from distributed import LocalCluster

        now, cluster = time.monotonic(), self._client.cluster
        if self._client.nthreads():
            self._last_seen = now
        elif self._last_seen is not None and now - self._last_seen >= self.PATIENCE:
            self._last_seen = None
            warn(
                f"SA306 no workers at {self._client.scheduler.address} for "
                f"{self.PATIENCE:g} s: {num_waiting} calls of the simulator "
                "wait for one; start workers there, or interrupt, which keeps what is "
                "finished",
                stacklevel=2,
            )
        if isinstance(cluster, LocalCluster):
            num_wanted = len(cluster.worker_spec)
            if len(cluster.workers) < num_wanted:
                cluster.scale(num_wanted)


def _ask_child(simulator: bytes, call: Call, time_limit: float | None) -> Reply:
    """Run a call in a child of this process, once.

    The first one that raises there, before any has an outcome, is tried here too: if
    that succeeds, the simulator needs what was set up here, and all its calls run here.
    """
    place = _place(simulator)
    if not place.get("is_here", False):
        # Dask's workers are daemons, to which Python allows no children; those here end
        # with their parent.
        current_process()._config.pop("daemon", None)  # pyright: ignore
        reply = WorkerPool(simulator, 1).ask(call, time_limit)
        if place or reply.fault not in ("raised", "not loaded"):
            place.update({} if reply.x is None else {"is_here": False})
            return reply
    reply = answer(_loaded(simulator), call)
    place.setdefault("is_here", reply.x is not None)
    return reply


@lru_cache(maxsize=4)
def _place(simulator: bytes) -> dict[str, bool]:
    """Return whether calls of a simulator run here, as far as that is known."""
    return {}


@lru_cache(maxsize=4)
def _loaded(simulator: bytes) -> Any:
    return cloudpickle.loads(simulator)

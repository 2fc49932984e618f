"""Pools that run calls of a simulator: here, in worker processes, or on Dask."""

from __future__ import annotations

import hashlib
import math
import os
import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, Future
from concurrent.futures import wait as first_of
from functools import lru_cache
from multiprocessing import current_process
from multiprocessing.connection import wait
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

    num_slots = 1

    @abstractmethod
    def submit(self, call: Call, time_limit: float | None) -> None:
        """Take a call.

        Args:
            call: The rows.
            time_limit: Seconds after which it is given up; None waits for ever.
        """

    @abstractmethod
    def finished(self) -> list[tuple[Call, Reply]]:
        """Wait for a call to end; return those that have."""

    def close(self) -> None:  # noqa: B027  # one has nothing to close
        """Give up what still runs."""


class InProcess(Pool):
    """Runs each call here.

    Args:
        simulator: Simulator of the calls.
    """

    def __init__(self, simulator: Callable[..., Any]) -> None:
        self._simulator = simulator
        self._calls: list[Call] = []

    @override
    def submit(self, call: Call, time_limit: float | None) -> None:
        self._calls.append(call)

    @override
    def finished(self) -> list[tuple[Call, Reply]]:
        call = self._calls.pop()
        return [(call, answer(self._simulator, call))]


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
        self.num_slots, self._simulator = num_workers, simulator
        environment = tuple(sorted(os.environ.items()))
        self._waiting = waiting_workers(
            simulator, os.getpid(), os.getcwd(), tuple(sys.path), environment
        )
        self._busy: dict[Any, Worker] = {}

    @override
    def submit(self, call: Call, time_limit: float | None) -> None:
        try:
            worker = self._waiting.pop()
        except IndexError:
            worker = Worker(self._simulator)
        worker.begin(call, time_limit)
        self._busy[worker.connection] = worker

    @override
    def finished(self) -> list[tuple[Call, Reply]]:
        done: list[tuple[Call, Reply]] = []
        while not done:
            until = min(worker.deadline for worker in self._busy.values())
            left = None if math.isinf(until) else max(until - time.monotonic(), 0.0)
            ready = wait([*self._busy], left)
            for connection, worker in [*self._busy.items()]:
                if connection not in ready and worker.deadline > time.monotonic():
                    continue
                reply = worker.reply()
                if reply is None:  # it has begun
                    continue
                del self._busy[connection]
                if reply.fault == "gone":  # while it waited, which costs no row
                    self.submit(worker.call, worker.time_limit)
                    continue
                done.append((worker.call, reply))
                if worker.end.alive:
                    self._waiting.append(worker)
        return done

    @override
    def close(self) -> None:
        for worker in self._busy.values():
            worker.end()


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

    #: Seconds between two looks at who is there, and without any worker until that is
    #: said.
    LOOK, PATIENCE = 0.5, 5.0

    def __init__(self, simulator: bytes, num_workers: int, client: Any) -> None:
        num_workers = effective_n_jobs(-1) if num_workers == -1 else num_workers
        self.num_slots = num_workers
        self._executor = client.get_executor(pure=False)
        self._client = client
        key = f"simulator-{hashlib.sha256(simulator).hexdigest()}"
        # A result, not scattered data: what a lost worker held can be made again.
        self._simulator = client.submit(bytes, simulator, key=key)
        self._calls: dict[Future[Reply], Call] = {}
        self._last_seen: float | None = time.monotonic()  # None once it was said

    @override
    def submit(self, call: Call, time_limit: float | None) -> None:
        what = (self._simulator, call, time_limit)
        self._calls[self._executor.submit(_ask_child, *what)] = call

    @override
    def finished(self) -> list[tuple[Call, Reply]]:
        while not (done := first_of(self._calls, self.LOOK, FIRST_COMPLETED).done):
            self._look()
        return [(self._calls.pop(future), _reply_of(future)) for future in done]

    @override
    def close(self) -> None:
        self._executor.shutdown(wait=False)

    def _look(self) -> None:
        """Say that no worker is there, and ask for those that were given up."""
        from distributed import LocalCluster

        now, cluster = time.monotonic(), self._client.cluster
        if self._client.nthreads():
            self._last_seen = now
        elif self._last_seen is not None and now - self._last_seen >= self.PATIENCE:
            self._last_seen = None
            warn(
                f"SA306 no workers at {self._client.scheduler.address} for "
                f"{self.PATIENCE:g} s: {len(self._calls)} calls of the simulator "
                "wait for one; start workers there, or interrupt, which keeps what is "
                "finished",
                stacklevel=2,
            )
        if isinstance(cluster, LocalCluster):
            num_wanted = len(cluster.worker_spec)
            if len(cluster.workers) < num_wanted:
                cluster.scale(num_wanted)


def _reply_of(future: Future[Reply]) -> Reply:
    try:
        return future.result()
    except Exception as error:  # whoever had the call was lost
        return Reply(fault="worker died", traceback=f"worker died: {error!r}")


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
        pool = WorkerPool(simulator, 1)
        pool.submit(call, time_limit)
        [(_, reply)] = pool.finished()
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

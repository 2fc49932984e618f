"""Calls on a cluster of Dask."""

from __future__ import annotations

import hashlib
import time
from functools import lru_cache
from multiprocessing import current_process
from queue import Empty
from typing import Any

import cloudpickle
from joblib import effective_n_jobs
from joblib.parallel import get_active_backend
from typing_extensions import override

from sbi_active.messages import warn
from sbi_active.simulation.workers.calls import Call, Reply, answer
from sbi_active.simulation.workers.pools import Pool, WorkerPool


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

    #: Seconds between two looks at who is there, where no call ends.
    LOOK = 0.5

    #: Seconds without any worker until that is said.
    PATIENCE = 5.0

    def __init__(self, simulator: bytes, num_workers: int, client: Any) -> None:
        super().__init__(effective_n_jobs(-1) if num_workers == -1 else num_workers)
        self._client = client
        key = f"simulator-{hashlib.sha256(simulator).hexdigest()}"
        # A result, not scattered data: what a lost worker held can be made again.
        self._simulator = client.submit(bytes, simulator, key=key)
        self._futures: set[Any] = set()
        self._last_seen: float | None = time.monotonic()  # None once it was said

    @override
    def ask(self, call: Call, time_limit: float | None) -> Reply:
        future = self._client.submit(
            _ask_child, self._simulator, call, time_limit, pure=False
        )
        self._futures.add(future)
        try:
            return future.result()
        except Exception as error:  # all Dask workers that had it were lost
            text = f"worker died: {error!r}"
            return Reply(fault="worker died", traceback=text)
        finally:
            self._futures.discard(future)

    @override
    def collect(self) -> tuple[Call, Reply]:
        while self._done.empty():
            try:
                self._done.put(self._done.get(timeout=self.LOOK))
            except Empty:
                self._look()
        return super().collect()

    @override
    def close(self) -> None:
        self._client.cancel([*self._futures])

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
                f"{self.PATIENCE:g} s: {len(self._futures)} calls of the simulator "
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

"""Calls on a cluster of Dask."""

from __future__ import annotations

import asyncio
import hashlib
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import CancelledError
from contextlib import closing, suppress
from functools import lru_cache
from multiprocessing import current_process
from typing import Any

import cloudpickle
from joblib import effective_n_jobs
from joblib.parallel import get_active_backend
from typing_extensions import override

from sbi_active.messages import warn
from sbi_active.simulation.workers.calls import Call, Reply, answer
from sbi_active.simulation.workers.pickling import pickled
from sbi_active.simulation.workers.pools import Pool, WorkerPool


def configured_client() -> Any:
    """Return the Dask client that ``joblib.parallel_config`` names, or None."""
    backend: Any = get_active_backend()[0]
    is_dask = type(backend).__name__ == "DaskDistributedBackend"
    return backend.client if is_dask else None


class DaskPool(Pool):
    """Runs calls as futures of a Dask client, each on a worker that is chosen here.

    joblib's own way to Dask waits for ever for a call that kills every worker it is
    given to, and Dask by itself gives the call of a lost worker to three others. Tied
    to one worker, a call that kills costs a single one, and it is known as soon as that
    worker is gone. It is not known which of the calls there was guilty, so their rows
    run apart from then on, in a child of a Dask worker, which is cheap to lose.

    A ``LocalCluster`` gives up each worker that is not back 15 s after its death
    (``distributed.deploy.lost-worker-timeout``), for good; those are asked for again.

    Args:
        simulator: Simulator, sent once to each worker.
        num_workers: Calls at a time.
        client: A ``distributed.Client``.
    """

    knows_guilty = False

    #: Seconds between two looks at who is there, and until a result that does not come
    #: makes one look again.
    LOOK, FETCH = 0.5, 5.0

    #: Seconds without any worker until that is said.
    PATIENCE = 5.0

    def __init__(
        self, simulator: Callable[..., Any], num_workers: int, client: Any
    ) -> None:
        self.num_slots = effective_n_jobs(-1) if num_workers == -1 else num_workers
        self._client = client
        blob = pickled(simulator)
        self._key = hashlib.sha256(blob).hexdigest()
        # A result, not scattered data: what a lost worker held can be made again.
        self._simulator = client.submit(_same, blob, key=f"simulator-{self._key}")
        self._waiting: list[Call] = []
        self._running: dict[Any, tuple[Call, str]] = {}
        self._at_risk: set[int] = set()  # rows whose worker died
        self._threads: dict[str, int] = {}
        self._last_seen: float | None = time.monotonic()  # None once it was said

    @property
    @override
    def num_free(self) -> int:
        return self.num_slots - len(self._running) - len(self._waiting)

    @override
    def submit(self, call: Call, time_limit: float | None) -> None:
        self._waiting.append(call)
        self._look()

    @override
    def collect(self) -> list[tuple[Call, Reply]]:
        from distributed import wait

        while self._waiting or self._running:
            with suppress(TimeoutError, asyncio.TimeoutError, CancelledError):
                if self._running:
                    wait([*self._running], self.LOOK, return_when="FIRST_COMPLETED")
                else:
                    time.sleep(self.LOOK)
            self._look()
            over = [f for f, (_, at) in self._running.items() if self._is_over(f, at)]
            if over:
                return [(self._running[f][0], self._reply(f)) for f in over]
        return []

    @override
    def close(self) -> None:
        self._client.cancel([*self._running])
        self._running, self._waiting = {}, []

    def _is_over(self, future: Any, worker: str) -> bool:
        return future.done() or worker not in self._threads

    def _reply(self, future: Any) -> Reply:
        call, worker = self._running.pop(future)
        error: Exception | None = None
        while future.done() and error is None:
            is_there = worker in self._threads
            try:
                return future.result(self.FETCH if is_there else self.LOOK)
            except (TimeoutError, asyncio.TimeoutError):  # lost, or long on its way
                self._threads = self._client.nthreads()
                if not is_there:
                    break
            except Exception as failure:
                error = failure
        self._client.cancel([future])
        self._at_risk.update(call.rows.tolist())
        reason = repr(error) if error else f"the Dask worker {worker} was lost with it"
        return Reply(fault="worker died", traceback=f"worker died: {reason}")

    def _look(self) -> None:
        """See which workers are there, and give them the calls that wait."""
        self._threads = self._client.nthreads()
        if self._threads:
            self._last_seen = time.monotonic()
        else:
            self._say_nobody_is_there()
        self._ask_for_workers_given_up()
        while self._waiting and self._threads:
            call, worker = self._waiting.pop(0), self._least_busy()
            is_at_risk = not self._at_risk.isdisjoint(call.rows.tolist())
            future = self._client.submit(
                _answer_apart if is_at_risk else _answer_on_cluster,
                self._simulator,
                call,
                pure=False,
                workers=[worker],
                allow_other_workers=False,
            )
            self._running[future] = (call, worker)

    def _least_busy(self) -> str:
        calls = Counter(worker for _, worker in self._running.values())
        return min(self._threads, key=lambda at: calls[at] / max(self._threads[at], 1))

    def _say_nobody_is_there(self) -> None:
        if self._last_seen is None:
            return
        if time.monotonic() - self._last_seen < self.PATIENCE:
            return
        self._last_seen = None
        warn(
            f"SA306 no workers at {self._client.scheduler.address} for "
            f"{self.PATIENCE:g} s: {len(self._waiting) + len(self._running)} calls of "
            "the simulator wait for one; start workers there, or interrupt, which "
            "keeps what is finished",
            stacklevel=2,
        )

    def _ask_for_workers_given_up(self) -> None:
        from distributed import LocalCluster

        cluster = self._client.cluster
        if isinstance(cluster, LocalCluster):
            num_wanted = len(cluster.worker_spec)
            if len(cluster.workers) < num_wanted:
                cluster.scale(num_wanted)


def _same(simulator: bytes) -> bytes:
    return simulator


@lru_cache(maxsize=4)
def _loaded(simulator: bytes) -> Callable[..., Any]:
    return cloudpickle.loads(simulator)


def _answer_on_cluster(simulator: bytes, call: Call) -> Reply:
    return answer(_loaded(simulator), call)


def _answer_apart(simulator: bytes, call: Call) -> Reply:
    """Run a call in a child of this process; what fails there otherwise, runs here."""
    with closing(_child(simulator)) as pool:
        pool.submit(call, None)
        ((_, reply),) = pool.collect()
    if reply.fault in (None, "worker died"):
        return reply
    return _answer_on_cluster(simulator, call)


def _child(simulator: bytes) -> WorkerPool:
    # Dask's workers are daemons, to which Python allows no children; those here end
    # with their parent.
    current_process()._config.pop("daemon", None)  # pyright: ignore
    return WorkerPool(_loaded(simulator), 1)

"""Calls on a cluster, or on any other executor that joblib knows."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from functools import lru_cache
from typing import Any

import cloudpickle
from joblib import Parallel, delayed, effective_n_jobs
from joblib.parallel import get_active_backend

from sbi_active.simulation.calls import Call, Reply, answer
from sbi_active.simulation.pools import Pool, pickled

__all__ = ["DaskPool", "JoblibPool", "configured_pool"]


def configured_pool(simulator: Callable[..., Any], num_workers: int) -> Pool | None:
    """Return the pool that ``joblib.parallel_config`` asks for; None for processes."""
    backend = _backend()
    name = type(backend).__name__
    if name == "LokyBackend":
        return None
    if name == "DaskDistributedBackend":
        return DaskPool(simulator, num_workers, backend.client)
    return JoblibPool(simulator, effective_n_jobs(num_workers))


class DaskPool(Pool):
    """Runs calls as futures of a Dask client.

    joblib's own way to Dask waits for ever for a call that kills every worker it is
    given to, so the futures are used themselves. Dask gives the call of a lost worker
    to another one, and gives it up once it has lost four
    (``distributed.scheduler.allowed-failures``). It counts every call that a lost
    worker had been given, so good calls in bad company are given up, too.

    Args:
        simulator: Sent once to each worker.
        num_workers: Calls at a time.
        client: A ``distributed.Client``.
    """

    knows_guilty = False

    def __init__(
        self, simulator: Callable[..., Any], num_workers: int, client: Any
    ) -> None:
        self.num_slots = effective_n_jobs(-1) if num_workers == -1 else num_workers
        self._client = client
        blob = pickled(simulator)
        self._key = hashlib.sha256(blob).hexdigest()
        # A result, not scattered data: what a lost worker held can be made again.
        self._simulator = client.submit(_same, blob, key=f"simulator-{self._key}")
        self._running: dict[Any, Call] = {}

    @property
    def num_free(self) -> int:
        return self.num_slots - len(self._running)

    def submit(self, call: Call, time_limit: float | None) -> None:
        future = self._client.submit(
            _answer_on_cluster, self._simulator, call, pure=False
        )
        self._running[future] = call

    def collect(self) -> list[tuple[Call, Reply]]:
        from distributed import wait

        if not self._running:
            return []
        wait([*self._running], return_when="FIRST_COMPLETED")
        done = [future for future in self._running if future.done()]
        return [(self._running.pop(f), _reply(f)) for f in done]

    def close(self) -> None:
        self._client.cancel([*self._running])
        self._running = {}


def _reply(future: Any) -> Reply:
    # One that is finished may fail nonetheless, if its result is lost with a worker.
    try:
        return future.result()
    except Exception as error:
        return Reply(fault="worker died", traceback=f"worker died: {error!r}")


class JoblibPool(Pool):
    """Runs calls in rounds through :class:`joblib.Parallel`.

    An exception costs its rows alone; a worker that dies ends the simulation wherever
    the executor does not replace it.

    Args:
        simulator: Sent with each call, and unpickled once a worker.
        num_workers: Calls at a time.
    """

    def __init__(self, simulator: Callable[..., Any], num_workers: int) -> None:
        self.num_slots = 4 * num_workers
        self._num_workers = num_workers
        self._simulator = pickled(simulator)
        self._waiting: list[Call] = []
        self._num_running = 0
        self._round: Iterator[tuple[Call, Reply]] | None = None

    @property
    def num_free(self) -> int:
        return 0 if self._round is not None else self.num_slots - len(self._waiting)

    def submit(self, call: Call, time_limit: float | None) -> None:
        self._waiting.append(call)

    def collect(self) -> list[tuple[Call, Reply]]:
        if self._round is None:
            self._round = self._start(self._waiting)
            self._num_running = len(self._waiting)
            self._waiting = []
        done = next(self._round)
        self._num_running -= 1
        if not self._num_running:
            next(self._round, None)  # lets joblib clear up
            self._round = None
        return [done]

    def _start(self, calls: list[Call]) -> Iterator[tuple[Call, Reply]]:
        streams = _backend().supports_return_generator
        parallel = Parallel(
            n_jobs=self._num_workers,
            return_as="generator_unordered" if streams else "list",
            batch_size=1,  # pyright: ignore[reportArgumentType]  # "auto" or a number
            pre_dispatch="all",
        )
        run = delayed(_answer_numbered)
        replies: Any = parallel(run(i, self._simulator, c) for i, c in enumerate(calls))
        for i, reply in replies:
            yield calls[i], reply


def _backend() -> Any:
    return get_active_backend()[0]


def _same(simulator: bytes) -> bytes:
    return simulator


@lru_cache(maxsize=4)
def _loaded(simulator: bytes) -> Callable[..., Any]:
    return cloudpickle.loads(simulator)


def _answer_on_cluster(simulator: bytes, call: Call) -> Reply:
    return answer(_loaded(simulator), call)


def _answer_numbered(number: int, simulator: bytes, call: Call) -> tuple[int, Reply]:
    return number, answer(_loaded(simulator), call)

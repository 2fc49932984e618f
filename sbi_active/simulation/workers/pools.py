"""Pools that run calls of a simulator: here, in worker processes, or on Dask.

A worker imports torch and this package, which takes seconds, so a simulator that kills
its process now and then would spend the night on imports. The fork server of
:mod:`multiprocessing` imports them once and forks the workers in milliseconds.
"""

from __future__ import annotations

import math
import multiprocessing as mp
import os
import pickle
import signal
import sys
import threading
import time
import traceback
import weakref
from collections.abc import Callable
from concurrent import futures
from contextlib import suppress
from functools import lru_cache
from importlib.machinery import ModuleSpec
from multiprocessing import forkserver, process, util
from multiprocessing.connection import Connection, wait
from typing import Any

import cloudpickle
import torch
from joblib.parallel import effective_n_jobs, get_active_backend
from threadpoolctl import threadpool_limits

from sbi_active.messages import warn
from sbi_active.simulation.model import SimulatorModel
from sbi_active.simulation.workers.calls import Call, Reply, answer
from sbi_active.simulation.workers.settings import Workers

#: Calls, and what came of each.
Replies = list[tuple[Call, Reply]]


class InProcess:
    """Runs each call here.

    Args:
        simulator: Simulator of the calls.
    """

    def __init__(self, simulator: Callable[..., Any]) -> None:
        self.num_slots, self._simulator = 1, simulator
        self._calls: list[Call] = []

    def submit(self, call: Call, time_limit: float | None) -> None:
        """Take a call, which has no limit here."""
        self._calls.append(call)

    def finished(self) -> Replies:
        """Run the call."""
        return [(call := self._calls.pop(), answer(self._simulator, call))]

    def close(self) -> None:
        """Do nothing."""


class Worker:
    """A process that has been sent a simulator and answers calls, one at a time.

    It has the folder, path and environment of this process at its start, and ends
    with it, or when nobody holds this object any more.

    Args:
        simulator: Simulator, pickled.

    Attributes:
        connection: Connection to it, which is ready when there is something to read.
        call: Call that it has, or had last.
        deadline: Time at which to give it up, by :func:`time.monotonic`.
        end: Function that ends it, and is alive before.
    """

    #: Seconds without a call after which it ends.
    PATIENCE = 60.0

    #: Seconds that loading the simulator may take, where its calls have a limit.
    LOADING = 600.0

    def __init__(self, simulator: bytes) -> None:
        self._is_loaded = False
        context: Any = mp.get_context("forkserver")
        self.connection, theirs = context.Pipe()
        # Libraries that a simulator loads use one thread: there is a worker a core.
        environment = {**os.environ, "OMP_NUM_THREADS": "1"}
        child = context.Process(target=_work, args=(theirs, environment))
        _start(context, child)
        theirs.close()
        # The end of this process neither waits for it nor is seen by who waits.
        process._children.discard(child)  # pyright: ignore
        self.end = weakref.finalize(self, _end, self.connection, child, os.getpid())
        self.end.atexit = False
        with suppress(OSError):  # that it died is seen when it is to reply
            self.connection.send_bytes(simulator)

    def begin(self, call: Call, time_limit: float | None) -> None:
        """Give it a call, whose time counts from when the simulator is loaded.

        Raises:
            EOFError, OSError: If it has ended while it waited.
        """
        self.call, self._time_limit, self.deadline = call, time_limit, math.inf
        if self._is_loaded:
            self.connection.send_bytes(pickle.dumps(call, protocol=5))
            self.connection.recv_bytes()  # it has it
        if time_limit is not None:
            self._seconds = time_limit if self._is_loaded else self.LOADING
            self.deadline = time.monotonic() + self._seconds

    def reply(self) -> Reply | None:
        """Return the reply to its call, or None if it has only loaded the simulator.

        For use when the connection is ready, or the time is over, which ends it.
        """
        fault = "worker died"
        try:
            if self.connection.poll():
                reply = pickle.loads(self.connection.recv_bytes())
                if reply is None:
                    self._is_loaded = True
                    self.begin(self.call, self._time_limit)
                return reply
            self.end()
            fault, text = "timed out", f"no answer within {self._seconds:g} s"
        except (EOFError, OSError):
            code = self.end() or 0
            how = "ended with code" if code >= 0 else "was ended by signal"
            during = "the call" if self._is_loaded else "loading"
            text = f"its process {how} {abs(code)} during {during}"
        lost = fault if self._is_loaded else "not loaded"
        return Reply(fault=lost, traceback=f"{fault}: {text}")


class WorkerPool:
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

    def submit(self, call: Call, time_limit: float | None) -> None:
        """Give a call to a worker that waits, or to a new one."""
        while self._waiting:
            worker = self._waiting.pop()
            with suppress(EOFError, OSError):  # it ended meanwhile: that costs no row
                worker.begin(call, time_limit)
                break
        else:
            worker = Worker(self._simulator)
            worker.begin(call, time_limit)
        self._busy[worker.connection] = worker

    def finished(self) -> Replies:
        """Wait for a while; return the calls that have ended."""
        until = min(worker.deadline for worker in self._busy.values())
        ready = wait([*self._busy], min(max(until - time.monotonic(), 0.0), 60.0))
        done: Replies = []
        for connection, worker in [*self._busy.items()]:
            if connection in ready or worker.deadline <= time.monotonic():
                reply = worker.reply()
                if reply is not None:
                    done.append((self._busy.pop(connection).call, reply))
                    if worker.end.alive and reply.fault != "not loaded":
                        self._waiting.append(worker)
        return done

    def close(self) -> None:
        """End the workers that still run a call."""
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


def _end(connection: Connection, child: Any, owner: int) -> int:
    """End a process; return its exit code, the negative signal if it was killed."""
    if os.getpid() != owner:  # it belongs to the parent of this forked child
        return 0
    connection.close()
    child.join(0.02)  # one that ends by itself has a moment, for its own code
    with suppress(ProcessLookupError, PermissionError):
        os.killpg(child.pid, signal.SIGKILL)  # with what it started
    child.kill()
    child.join()
    return child.exitcode or 0


_START = threading.Lock()


def _forget() -> None:
    # A forked child can neither ask nor wait for the server of its parent, and would
    # keep it alive.
    server: Any = forkserver._forkserver  # pyright: ignore
    if server._forkserver_alive_fd is not None:
        os.close(server._forkserver_alive_fd)
    server.__init__()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget)


def _start(context: Any, child: Any) -> None:
    """Start a process that does not run the main module again, which may lack a guard.

    :mod:`multiprocessing` runs none that bears this name.
    """
    main = sys.modules["__main__"]
    with _START:
        spec, main.__spec__ = main.__spec__, ModuleSpec("__main__", None)
        try:
            context.set_forkserver_preload([__name__])  # for the first one
            child.start()
        finally:
            main.__spec__ = spec


def _work(connection: Connection, environment: dict[str, str]) -> None:
    """Load a simulator and answer calls, until there are no more."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides
    os.setpgid(0, 0)  # so that what a simulator starts ends with it
    util.Finalize(None, os.killpg, (0, signal.SIGKILL), exitpriority=0)
    threading.Thread(target=_end_with, args=(os.getppid(),), daemon=True).start()
    try:
        os.environ.clear()
        os.environ.update(environment)
        simulator = cloudpickle.loads(connection.recv_bytes())
        threadpool_limits(1)
        torch.set_num_threads(1)
        if isinstance(simulator, SimulatorModel):
            simulator.prepare()  # no row's time limit counts it
        loaded = None
    except BaseException:
        loaded = Reply(fault="not loaded", traceback=traceback.format_exc())
    with suppress(EOFError, OSError):  # nobody waits for it any more
        connection.send_bytes(pickle.dumps(loaded))
        while not loaded and connection.poll(Worker.PATIENCE):
            content = connection.recv_bytes()
            connection.send_bytes(b"")
            reply = answer(simulator, pickle.loads(content), BaseException)
            sys.stdout.flush()
            sys.stderr.flush()
            connection.send_bytes(pickle.dumps(reply, protocol=5))


def _end_with(server: int) -> None:
    """Wait until whoever asked for this process ends, or who forked it; then end."""
    parent: Any = mp.parent_process()
    with suppress(OSError):  # no such process
        # A forked child of the parent may hold the other end of the sentinel open.
        while os.getppid() == server and not wait([parent.sentinel], timeout=0.5):
            os.kill(parent.pid, 0)
    os.killpg(0, signal.SIGKILL)


def pickled(simulator: Callable[..., Any]) -> bytes:
    """Return the simulator as bytes, which ``cloudpickle.loads`` reads.

    Args:
        simulator: Any callable.

    Raises:
        TypeError: If it cannot be pickled.
    """
    try:
        return cloudpickle.dumps(simulator)
    except Exception as error:
        raise TypeError(
            "expected a simulator that can travel to another process; got "
            f"{type(error).__name__}: {error}; open files and engines in the setup "
            "of a SimulatorModel, or run it here without workers="
        ) from error


class DaskPool:
    """Runs calls as futures of a Dask client, each in a child of a Dask worker.

    A call that kills its process, or is killed at its time limit, so costs a child,
    which is cheap. The call of a Dask worker that is lost otherwise goes to another.

    Args:
        simulator: Simulator, pickled; it is sent once to each Dask worker.
        num_workers: Number of calls at a time; -1 means one a core of the cluster.
        client: A ``distributed.Client``.
    """

    #: Seconds without an answer after which it is looked who is there.
    PATIENCE = 5.0

    def __init__(self, simulator: bytes, num_workers: int, client: Any) -> None:
        num_workers = effective_n_jobs(-1) if num_workers == -1 else num_workers
        self.num_slots, self._client = num_workers, client
        self._executor = client.get_executor(pure=False)
        # A result, not scattered data: what a lost worker held can be made again.
        self._simulator = client.submit(bytes, simulator)
        self._calls: dict[futures.Future[Reply], Call] = {}

    def submit(self, call: Call, time_limit: float | None) -> None:
        """Send a call to the cluster."""
        what = (self._simulator, call, time_limit)
        self._calls[self._executor.submit(ask_child, *what)] = call

    def finished(self) -> Replies:
        """Wait for a while; return the calls that have ended."""
        done, _ = futures.wait(self._calls, self.PATIENCE, "FIRST_COMPLETED")
        if not done:
            self._look()
        replies: Replies = []
        for future in done:
            error = future.exception()  # if whoever had the call was lost
            lost = Reply(fault="worker died", traceback=f"worker died: {error!r}")
            replies += [(self._calls.pop(future), lost if error else future.result())]
        return replies

    def close(self) -> None:
        """Give up what still runs."""
        self._executor.shutdown(wait=False)

    def _look(self) -> None:
        """Say that no worker is there, and ask for those that were given up."""
        if not self._client.nthreads():
            warn(
                f"SA306 no workers at {self._client.scheduler.address}: "
                f"{len(self._calls)} calls of the simulator wait for one; start "
                "workers there, or interrupt, which keeps what is finished"
            )
        # A LocalCluster gives up each worker that is not back 15 s after its death.
        if hasattr(cluster := self._client.cluster, "worker_spec"):
            cluster.scale(len(cluster.worker_spec))


def ask_child(simulator: bytes, call: Call, time_limit: float | None) -> Reply:
    """Run a call in a child of this process."""
    # Dask's workers are daemons, to which Python allows no children; those here end
    # with their parent.
    mp.current_process()._config.pop("daemon", None)  # pyright: ignore
    pool = WorkerPool(simulator, 1)
    pool.submit(call, time_limit)
    while not (done := pool.finished()):
        pass
    return done[0][1]


#: Runs calls, ``num_slots`` at a time, and hands back what came of them in any order.
Pool = InProcess | WorkerPool | DaskPool


def pool_of(simulator: Callable[..., Any], workers: Workers) -> Pool:
    """Return the pool in which workers run a simulator."""
    if workers.num_workers == 1 and workers.time_limit is None:
        return InProcess(simulator)
    backend: Any = get_active_backend()[0]
    if type(backend).__name__ == "DaskDistributedBackend":
        return DaskPool(pickled(simulator), workers.num_workers, backend.client)
    return WorkerPool(pickled(simulator), effective_n_jobs(workers.num_workers))

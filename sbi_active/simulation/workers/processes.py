"""Worker processes that may die: cheap to start, and each killed without the others.

A worker imports torch and this package, which takes seconds, so a simulator that kills
its process now and then would spend the night on imports. Here a *nest*, a clean
process that has imported them and does nothing else, forks the workers in
milliseconds. The nest is started by loky, which does not run the user's main module
again, and is kept for the next simulations of this process. Where there is no safe
fork (Windows, macOS) each worker is started by loky itself.
"""

from __future__ import annotations

import atexit
import ctypes
import os
import pickle
import signal
import sys
import threading
import time
import traceback
from contextlib import suppress
from multiprocessing.connection import Connection
from multiprocessing.reduction import recv_handle, send_handle
from typing import Any

import cloudpickle
import torch
from joblib.externals.loky.backend import get_context

from sbi_active.simulation.model import SimulatorModel
from sbi_active.simulation.workers.calls import Reply, answer

_FORKS = sys.platform.startswith("linux")

_LOKY: Any = get_context("loky")

_PATIENCE = 1.0  # s
_PR_SET_PDEATHSIG = 1  # <sys/prctl.h>

#: A worker's libraries use one thread: there is a worker a core.
_ONE_THREAD = {
    f"{name}_NUM_THREADS": "1"
    for name in ("OMP", "MKL", "OPENBLAS", "BLIS", "NUMEXPR", "VECLIB")
}


def surroundings() -> dict[str, Any]:
    """Return folder, path and environment, which may change while the nest lives."""
    return {
        "folder": os.getcwd(),
        "path": list(sys.path),
        "environment": {**os.environ, **_ONE_THREAD},
    }


class Worker:
    """A process that has been sent a simulator and answers calls, one at a time.

    Args:
        simulator: Pickled.
        surroundings: Where it runs, see :func:`surroundings`.

    Attributes:
        connection: Gives None once the simulator is loaded, then a reply a call, all
            pickled; and an end of file where the process died.
        is_ready: Whether the simulator has been loaded.
    """

    def __init__(self, simulator: bytes, surroundings: dict[str, Any]) -> None:
        self.is_ready = False
        self.connection, theirs = _LOKY.Pipe()
        if _FORKS:
            self._nest = _nest()
            self.pid = self._nest.fork(theirs, surroundings)
        else:
            self._process = _LOKY.Process(
                target=_work, args=(theirs, surroundings), env=_ONE_THREAD
            )
            self._process.start()
        theirs.close()
        with suppress(OSError):
            self.send(simulator)

    def send(self, message: bytes) -> None:
        """Send the simulator or a call, pickled."""
        self.connection.send_bytes(message)

    def end(self) -> int:
        """Kill the process if it lives; return its exit code, minus the signal."""
        self.connection.close()
        if _FORKS:
            return self._nest.end(self.pid)
        self._process.kill()
        self._process.join()
        return self._process.exitcode or 0


class _Nest:
    """The process that forks workers, seen from the process that asks for them."""

    def __init__(self) -> None:
        self.owner = os.getpid()
        self._lock = threading.Lock()
        self._control, theirs = _LOKY.Pipe()
        self._process: Any = _LOKY.Process(
            target=_hatch, args=(theirs,), env=_ONE_THREAD
        )
        self._process.start()
        theirs.close()
        atexit.register(self.close)

    @property
    def is_alive(self) -> bool:
        # A child of this process inherits the object, but not the process.
        return self.owner == os.getpid() and self._process.is_alive()

    def fork(self, connection: Connection, surroundings: dict[str, Any]) -> int:
        """Return the process number of a new worker that reads the connection."""
        try:
            return self._ask("fork", surroundings, connection)
        except (EOFError, OSError) as error:
            raise RuntimeError(
                "expected a process that starts workers; got its end (code "
                f"{self._process.exitcode}); look for its last words above, or "
                "simulate with num_workers=1"
            ) from error

    def end(self, pid: int) -> int:
        """Kill a worker and what it started; return its exit code."""
        try:
            return self._ask("end", pid)
        except (EOFError, OSError):
            return -signal.SIGKILL  # the nest is gone, and its workers with it

    def _ask(
        self, order: str, argument: Any, connection: Connection | None = None
    ) -> int:
        with self._lock:
            try:
                self._control.send((order, argument))
                if connection is not None:
                    send_handle(self._control, connection.fileno(), self._process.pid)
                return self._control.recv()
            except BaseException:
                # An interrupt here would leave an answer to be mistaken for the next.
                self.close()
                raise

    def close(self) -> None:
        """Let the nest and its workers end."""
        if self.owner == os.getpid():
            self._control.close()
            self._process.join()


_NEST: _Nest | None = None


def _nest() -> _Nest:
    global _NEST
    if _NEST is None or not _NEST.is_alive:
        _NEST = _Nest()
    return _NEST


def _hatch(control: Connection) -> None:
    """Fork and end workers as asked, until the asking process is gone."""
    # A signal to the whole group must not end it before the workers, nor if the asking
    # process goes on.
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    workers: set[int] = set()
    with suppress(EOFError, OSError):
        while _has_order(control):
            order, argument = control.recv()
            if order == "end":
                workers.discard(argument)
                control.send(_end(argument))
            else:
                pid = _fork(control, argument)
                workers.add(pid)
                control.send(pid)
    for pid in workers:
        _end(pid)


def _has_order(control: Connection) -> bool:
    """Wait for an order; return False once the asking process is gone.

    Its death closes the connection, but not where a child of it holds a copy.
    """
    parent = os.getppid()
    while not control.poll(_PATIENCE):
        if os.getppid() != parent:
            return False
    return True


def _fork(control: Connection, surroundings: dict[str, Any]) -> int:
    handle = recv_handle(control)
    nest = os.getpid()
    pid = os.fork()
    if pid == 0:
        control.close()
        try:
            _die_with(nest)
            for number in (signal.SIGTERM, signal.SIGHUP):
                signal.signal(number, signal.SIG_DFL)
            os.setpgid(0, 0)  # so that what a simulator starts ends with it
            _work(Connection(handle), surroundings)
        finally:
            os._exit(0)  # the nest's own clean-up is not the worker's
    with suppress(OSError):  # the worker may have been faster
        os.setpgid(pid, pid)
    os.close(handle)
    return pid


def _die_with(parent: int) -> None:
    """Have Linux kill this process when its parent ends, in whatever way."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # it was faster
        os._exit(1)


def _end(pid: int) -> int:
    # One that died by itself is given a moment to be seen dead, for its own exit code.
    # Until waited for it keeps its number, so that the signal hits nothing else.
    peek = os.WEXITED | os.WNOHANG | os.WNOWAIT
    for _ in range(20):
        if os.waitid(os.P_PID, pid, peek) is not None:
            break
        time.sleep(1e-3)
    with suppress(ProcessLookupError, PermissionError):
        os.killpg(pid, signal.SIGKILL)
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])


def _work(connection: Connection, surroundings: dict[str, Any]) -> None:
    """Load a simulator and answer calls, until there are no more."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides
    torch.set_num_threads(1)
    try:
        os.environ.clear()
        os.environ.update(surroundings["environment"])
        sys.path[:] = surroundings["path"]
        os.chdir(surroundings["folder"])
        simulator = cloudpickle.loads(connection.recv_bytes())
        if isinstance(simulator, SimulatorModel):
            simulator.prepare()  # no row's time limit counts it
    except BaseException:  # the process ends, and says why
        reply = Reply(fault="not loaded", traceback=traceback.format_exc())
        connection.send_bytes(pickle.dumps(reply))
        return
    connection.send_bytes(pickle.dumps(None))
    while True:
        try:
            call = pickle.loads(connection.recv_bytes())
        except (EOFError, OSError):
            return
        reply = answer(simulator, call, catches=BaseException)
        sys.stdout.flush()
        sys.stderr.flush()
        with suppress(OSError):  # nobody waits for it any more
            connection.send_bytes(pickle.dumps(reply, protocol=5))

"""Worker processes that may die: cheap to start, and each killed without the others.

A worker imports torch and this package, which takes seconds, so a simulator that kills
its process now and then would spend the night on imports. The fork server of
:mod:`multiprocessing` imports them once and forks the workers in milliseconds. Where
there is no safe fork (Windows, macOS) each worker is spawned.
"""

from __future__ import annotations

import ctypes
import os
import pickle
import signal
import sys
import threading
import time
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib import import_module
from importlib.machinery import ModuleSpec
from math import inf
from multiprocessing import get_context, parent_process, process
from multiprocessing.connection import Connection, wait
from typing import Any

import cloudpickle

from sbi_active.simulation.model import SimulatorModel
from sbi_active.simulation.workers.calls import Call, Reply, answer

_FORKS = sys.platform.startswith("linux")

_CONTEXT: Any = get_context("forkserver" if _FORKS else "spawn")

_ONE_THREAD = f"{__package__}.one_thread"

_PR_SET_PDEATHSIG = 1  # <sys/prctl.h>

#: Libraries that a simulator loads use one thread: there is a worker a core.
_ENVIRONMENT = {
    f"{name}_NUM_THREADS": "1"
    for name in ("OMP", "MKL", "OPENBLAS", "BLIS", "NUMEXPR", "VECLIB")
}


class Worker:
    """A process that has been sent a simulator and answers calls, one at a time.

    It has the folder, path and environment of this process at its start.

    Args:
        simulator: Pickled.

    Attributes:
        connection: Connection that gives None at the start of a call and then its
            reply, both pickled; and an end of file where the process died.
        call: Call that it was given last.
        deadline: Time when that is given up, which is known once it has been started.
    """

    call: Call
    deadline: float

    def __init__(self, simulator: bytes) -> None:
        self._simulator = simulator
        self._has_answered = False
        self.connection, theirs = _CONTEXT.Pipe()
        environment = {**os.environ, **_ENVIRONMENT}
        self._process = _CONTEXT.Process(target=_work, args=(theirs, environment))
        with _main_module_left_alone():
            if _FORKS:  # of no effect once the server runs
                _CONTEXT.set_forkserver_preload([__name__, _ONE_THREAD])
            self._process.start()
        # Its end is ours to see to, not that of the interpreter, which would wait.
        process._children.discard(self._process)  # pyright: ignore
        theirs.close()
        with suppress(OSError):
            self.connection.send_bytes(simulator)

    def start(self, call: Call, time_limit: float | None) -> None:
        """Send a call."""
        self.call, self.deadline = call, inf
        self._time_limit = time_limit
        self._has_started = False
        with suppress(OSError):  # it has died, as reply() will find
            self.connection.send_bytes(pickle.dumps(call, protocol=5))

    def reply(self) -> Reply | None:
        """Return the reply of the call; None while it runs."""
        try:
            while self.connection.poll():
                reply = pickle.loads(self.connection.recv_bytes())
                if reply is not None:
                    self._has_answered = True
                    return reply
                self._has_started = True
                if self._time_limit is not None:
                    self.deadline = time.monotonic() + self._time_limit
        except (EOFError, OSError):
            return self._last_words()
        if time.monotonic() < self.deadline:
            return None
        text = f"timed out: no answer within {self._time_limit:g} s"
        return Reply(fault="timed out", traceback=text)

    def _last_words(self) -> Reply | None:
        code = self.end()
        how = f"was ended by signal {-code}" if code < 0 else f"ended with code {code}"
        if self._has_started:
            text = f"worker died: its process {how} during the call, without an"
            return Reply(fault="worker died", traceback=f"{text} exception")
        if not self._has_answered:
            text = f"the process {how} while it loaded the simulator"
            return Reply(fault="not loaded", traceback=text)
        self.__init__(self._simulator)  # it died while it waited, which costs no row
        self.start(self.call, self._time_limit)
        return None

    def end(self) -> int:
        """Kill the process and what it started; return its exit code.

        The code of a killed process is its negative signal.
        """
        if self.connection.closed:
            return self._process.exitcode or 0
        self.connection.close()
        # One that died by itself is given a moment to be seen dead, for its own code.
        self._process.join(0.02)
        if _FORKS:
            with suppress(ProcessLookupError, PermissionError):
                os.killpg(self._process.pid, signal.SIGKILL)
        self._process.kill()
        self._process.join()
        return self._process.exitcode or 0


_START = threading.Lock()


@contextmanager
def _main_module_left_alone() -> Iterator[None]:
    """Have a worker not run the main module again, which may lack a guard.

    `multiprocessing` does not run one that bears this name.
    """
    main = sys.modules["__main__"]
    with _START:
        spec = main.__spec__
        main.__spec__ = ModuleSpec("__main__", None)
        try:
            yield
        finally:
            main.__spec__ = spec


def _forget() -> None:
    # A forked child can neither ask nor wait for the server of its parent, and would
    # keep it alive.
    from multiprocessing import forkserver

    server: Any = forkserver.ensure_running.__self__  # pyright: ignore
    if server._forkserver_alive_fd is not None:
        os.close(server._forkserver_alive_fd)
    server.__init__()
    _START.__init__()


if _FORKS:
    os.register_at_fork(after_in_child=_forget)


def _work(connection: Connection, environment: dict[str, str]) -> None:
    """Load a simulator and answer calls, until there are no more."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides
    if _FORKS:
        _end_with_parent()
    import_module(_ONE_THREAD)
    try:
        os.environ.clear()
        os.environ.update(environment)
        simulator = cloudpickle.loads(connection.recv_bytes())
        if isinstance(simulator, SimulatorModel):
            simulator.prepare()  # no row's time limit counts it
    except BaseException:  # the process ends, and says why
        reply = Reply(fault="not loaded", traceback=traceback.format_exc())
        connection.send_bytes(pickle.dumps(reply))
        return
    with suppress(EOFError, OSError):  # nobody waits for it any more
        while True:
            call = pickle.loads(connection.recv_bytes())
            connection.send_bytes(pickle.dumps(None))
            reply = answer(simulator, call, catches=BaseException)
            sys.stdout.flush()
            sys.stderr.flush()
            connection.send_bytes(pickle.dumps(reply, protocol=5))


def _end_with_parent() -> None:
    """End with whoever asked for this process, and with the server that forked it."""
    os.setpgid(0, 0)  # so that what a simulator starts ends with it
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    threading.Thread(target=_outlive_nobody, daemon=True).start()


def _outlive_nobody() -> None:
    parent = parent_process()
    assert parent is not None
    assert parent.pid is not None
    with suppress(OSError):  # no such process
        # A forked child of the parent may hold the other end of the sentinel open.
        while not wait([parent.sentinel], timeout=1.0):
            os.kill(parent.pid, 0)
    os.killpg(0, signal.SIGKILL)

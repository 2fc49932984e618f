"""Worker processes that may die: cheap to start, and each killed without the others.

A worker imports torch and this package, which takes seconds, so a simulator that kills
its process now and then would spend the night on imports. The fork server of
:mod:`multiprocessing` imports them once and forks the workers in milliseconds. Where
there is no safe fork (Windows, macOS) each worker is spawned.
"""

from __future__ import annotations

import io
import math
import os
import pickle
import signal
import sys
import threading
import time
import traceback
import weakref
from collections import ChainMap
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from importlib.machinery import ModuleSpec
from multiprocessing import get_context, parent_process, process, util
from multiprocessing.connection import Connection, wait
from types import CodeType
from typing import Any, cast

import cloudpickle
import torch
from threadpoolctl import threadpool_limits

from sbi_active.simulation.model import SimulatorModel
from sbi_active.simulation.workers.calls import Call, Reply, answer

_FORKS = sys.platform.startswith("linux")

_CONTEXT: Any = get_context("forkserver" if _FORKS else "spawn")

#: Libraries that a simulator loads use one thread: there is a worker a core.
_ENVIRONMENT = {
    f"{name}_NUM_THREADS": "1"
    for name in ("OMP", "MKL", "OPENBLAS", "BLIS", "NUMEXPR", "VECLIB")
}


class Worker:
    """A process that has been sent a simulator and answers calls, one at a time.

    It has the folder, path and environment of this process at its start, and ends
    when nobody holds this object any more. It says that it has loaded the simulator,
    that it begins a call, and what came of it.

    Args:
        simulator: Simulator, pickled.

    Attributes:
        connection: Connection to it, which is ready when there is something to read.
        call: Call that it has, or had last.
        time_limit: Seconds that the call may take; None is any time.
        deadline: Time at which to give it up, by :func:`time.monotonic`.
        end: Function that ends it, and is alive before.
    """

    #: Seconds without a call after which it ends.
    PATIENCE = 60.0

    call: Call
    time_limit: float | None
    deadline: float

    def __init__(self, simulator: bytes) -> None:
        self._is_loaded = self._has_begun = False
        self.connection, theirs = _CONTEXT.Pipe()
        environment = {**os.environ, **_ENVIRONMENT}
        self._process = _CONTEXT.Process(
            target=_work, args=(theirs, environment, self.PATIENCE)
        )
        with _main_module_left_alone():
            if _FORKS:  # of no effect once the server runs
                _CONTEXT.set_forkserver_preload([__name__])
            self._process.start()
        # Its end is ours to see to, not that of the interpreter, which would wait.
        process._children.discard(self._process)  # pyright: ignore
        theirs.close()
        # Called at the latest when nobody holds this object, or this process ends.
        self.end = weakref.finalize(
            self, _end, self.connection, self._process, os.getpid()
        )
        self._send(simulator)

    def begin(self, call: Call, time_limit: float | None) -> None:
        """Give it a call, whose time counts from when it begins."""
        self.call, self.time_limit, self.deadline = call, time_limit, math.inf
        self.end.atexit = False  # whoever waits for it would see it end
        if self._is_loaded:
            self._send(pickle.dumps(call, protocol=5))

    def reply(self) -> Reply | None:
        """Return the reply to its call, or None if it has only begun.

        For use when the connection is ready, or the time is over, which ends it.
        """
        if not self.connection.poll():
            self.end()
            text = f"timed out: no answer within {self.time_limit:g} s"
            return Reply(fault="timed out", traceback=text)
        try:
            reply = pickle.loads(self.connection.recv_bytes())
        except (EOFError, OSError):
            return self._lost()
        if reply is not None:
            self._has_begun, self.end.atexit = False, True
            if not self._is_loaded:
                self.end()
        elif self._is_loaded:
            self._has_begun = True
            if self.time_limit is not None:
                self.deadline = time.monotonic() + self.time_limit
        else:
            self._is_loaded = True
            self._send(pickle.dumps(self.call, protocol=5))
        return reply

    def _lost(self) -> Reply:
        code = self.end() or 0
        how = f"was ended by signal {-code}" if code < 0 else f"ended with code {code}"
        if self._has_begun:
            text = f"worker died: its process {how} during the call, without an"
            return Reply(fault="worker died", traceback=f"{text} exception")
        if self._is_loaded:
            return Reply(fault="gone")
        text = f"the process {how} while it loaded the simulator"
        return Reply(fault="not loaded", traceback=text)

    def _send(self, content: bytes) -> None:
        with suppress(OSError):  # that it died is seen when it is to reply
            self.connection.send_bytes(content)


def _end(connection: Connection, process: Any, owner: int) -> int:
    """End a process; return its exit code, the negative signal if it was killed."""
    if os.getpid() != owner:  # it belongs to the parent of this forked child
        return 0
    connection.close()
    # One that ends by itself is given a moment, for its own code and its finalizers.
    process.join(0.02)
    if _FORKS:  # with what it started
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, signal.SIGKILL)
    process.kill()
    process.join()
    return process.exitcode or 0


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


def _work(connection: Connection, environment: dict[str, str], patience: float) -> None:
    """Load a simulator and answer calls, until there are no more."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides
    if _FORKS:
        _end_with_parent()
    torch.set_num_threads(1)
    threadpool_limits(1)
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
        connection.send_bytes(pickle.dumps(None))
        while connection.poll(patience):
            call = pickle.loads(connection.recv_bytes())
            connection.send_bytes(pickle.dumps(None))
            reply = answer(simulator, call, catches=BaseException)
            sys.stdout.flush()
            sys.stderr.flush()
            connection.send_bytes(pickle.dumps(reply, protocol=5))


def _end_with_parent() -> None:
    """End with whoever asked for this process, and with the server that forked it."""
    os.setpgid(0, 0)  # so that what a simulator starts ends with it
    util.Finalize(None, os.killpg, (0, signal.SIGKILL), exitpriority=0)
    threading.Thread(target=_outlive_nobody, args=(os.getppid(),), daemon=True).start()


def _outlive_nobody(server: int) -> None:
    parent = parent_process()
    assert parent is not None
    assert parent.pid is not None
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
    buffer = io.BytesIO()
    try:
        _Pickler(buffer).dump(simulator)
    except Exception as error:
        raise TypeError(
            "expected a simulator that can travel to another process; got "
            f"{type(error).__name__}: {error}; open files and engines in the setup "
            "of a SimulatorModel, or run it here without workers="
        ) from error
    return buffer.getvalue()


def _reduced(code: CodeType) -> tuple[Any, ...]:
    rebuild, arguments, *_ = cloudpickle.CloudPickler.dispatch_table[CodeType](code)
    return _rebuilt, (code.co_filename, rebuild, arguments)


def _rebuilt(
    filename: str, rebuild: Callable[..., CodeType], arguments: tuple[Any, ...]
) -> CodeType:
    return rebuild(*arguments).replace(co_filename=filename)


class _Pickler(cloudpickle.CloudPickler):
    """Pickles code with the name of its file.

    From 3.1.3 on cloudpickle leaves it out, and a traceback from a worker would then
    show no line of the simulator.
    """

    # A view: what is registered with copyreg later counts as well.
    dispatch_table: Any = ChainMap(
        {CodeType: _reduced}, cast("dict", cloudpickle.CloudPickler.dispatch_table)
    )

"""What an attack is: a function that raises where the library does not survive it."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import resource
import signal
import tempfile
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

#: Where the checkout lies, which rows do not tell.
ROOT = str(Path(__file__).parents[2])


@dataclass(frozen=True)
class Attack:
    """One way to break the library.

    Attributes:
        name: What is done, in a few words.
        run: Takes a case and raises where the library does not survive: an assertion
            about a number, or an error that is not the one expected.
        cases: What the attack is run with, one after another, each in a process of its
            own.
        seconds: Wall time after which it counts as hanging.
    """

    name: str
    run: Callable[[Any], None]
    cases: tuple[Any, ...]
    seconds: float


class Attacks(list[Attack]):
    """The attacks on one area, in the order in which they are written.

    Example:
        >>> attacks = Attacks()
        >>> @attacks.add("a number is NaN", cases=(1, 2))
        ... def nan_is_refused(case):
        ...     assert case > 0
        >>> attacks[0].name, attacks[0].cases
        ('a number is NaN', (1, 2))
    """

    def add(
        self, name: str, *, cases: Sequence[Any] = ("",), seconds: float = 120.0
    ) -> Callable[[Callable[[Any], None]], Callable[[Any], None]]:
        """Return a decorator that appends an attack.

        Args:
            name: Of the attack.
            cases: What it is run with; each prints as itself in the table.
            seconds: Wall time that a case may take.
        """

        def register(run: Callable[[Any], None]) -> Callable[[Any], None]:
            self.append(Attack(name, run, tuple(cases), seconds))
            return run

        return register


@dataclass(frozen=True)
class Outcome:
    """What came of a case: whether it was survived, in which words if not, its cost."""

    survived: bool
    answer: str
    cpu_seconds: float


def attempt(attack: Attack, case: Any) -> Outcome:
    """Run a case in a forked process group, which is killed when its time is over."""
    context = multiprocessing.get_context("fork")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_run, args=(attack, case, sender))
    process.start()
    sender.close()
    assert process.pid is not None
    try:
        if receiver.poll(attack.seconds):
            answer, cpu_seconds = receiver.recv()
            return Outcome(answer == "", answer, cpu_seconds)
        return Outcome(False, f"hangs: no end within {attack.seconds:g} s", 0.0)
    except EOFError:
        process.join(10)
        return Outcome(False, f"its process died (exit {process.exitcode})", 0.0)
    finally:
        _kill(process.pid)
        process.join()


def _run(attack: Attack, case: Any, sender: Any) -> None:
    os.setsid()  # its workers end with it
    torch.set_num_threads(1)  # a pool of threads does not survive the fork
    quiet = os.open(os.devnull, os.O_WRONLY)
    os.dup2(quiet, 1)
    os.dup2(quiet, 2)
    answer = ""
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        try:
            attack.run(case)
        except BaseException as error:
            last = traceback.extract_tb(error.__traceback__)[-1]
            text = " ".join(str(error).replace(ROOT, ".").split())[:200]
            answer = f"{type(error).__name__} in {last.name}: {text}"
        used = [
            resource.getrusage(who)
            for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
        ]
        sender.send((answer, sum(u.ru_utime + u.ru_stime for u in used)))


def _kill(group: int) -> None:
    with contextlib.suppress(ProcessLookupError):  # it ended, and all that it started
        os.killpg(group, signal.SIGKILL)

"""What the library survives: an adversary's table, tried and survived by area.

    python -m benchmarks robustness
    python -m benchmarks robustness --area campaign
    python -m benchmarks robustness --summary

Each case runs in a process of its own with a time limit, and counts as survived where
the library gives the right numbers, or the error that names the fault; a wrong number,
another error, a hang or a dead process counts as not survived. Areas with attacks of
their own are modules here. What was tried in the others has become tests: an attack is
a test function of a folder, and a case is what it is called with. Rows of these that
are committed are of the attacks as they stood here (2026-11-27).

Resumable: a case that stands in ``results/AREA.csv`` is not run again; ``--fresh`` runs
an area anew.

What an attack is: a function that raises where the library does not survive it.
"""

from __future__ import annotations

import contextlib
import importlib
import multiprocessing
import os
import resource
import signal
import subprocess
import sys
import tempfile
import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any
from xml.etree import ElementTree

import torch

from benchmarks.rows import append, read

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


#: Areas, and the tests that hold them; none where attacks stand in a module here.
AREAS: dict[str, tuple[str, ...]] = {
    "engine": ("tests/simulation/workers", "tests/simulation/test_*.py"),
    "bank": ("tests/simulation/bank",),
    "campaign": ("tests/campaign/test_*.py",),
    "criticism": ("tests/criticism/test_*.py",),
    "effects_and_reports": ("tests/criticism/effects", "tests/criticism/report"),
    "parameters": (),
    "threads_and_locks": ("tests/campaign/storage",),
    "crafted_files": ("tests/campaign/storage",),
    "command_line": ("tests/cli",),
    "tables": ("tests/criticism/data",),
    "mujoco_robots": ("tests/mujoco",),
    "priors": (),
    "process_state": (),
}
RESULTS = Path(__file__).parent / "results"
LONGEST = 3_600.0  # s that all tests of an area may take
Row = dict[str, object]


def attacks_on(area: str) -> list[Attack]:
    """Return the attacks on an area, from the module of its name."""
    return importlib.import_module(f"benchmarks.robustness.{area}").ATTACKS


def rows_of(area: str) -> list[dict[str, str]]:
    """Return the committed rows of an area."""
    return read(RESULTS / f"{area}.csv")


def attacked(area: str, done: set[tuple[str, str]]) -> Iterator[Row]:
    """Yield the rows of the cases of a module that are not done."""
    for attack in attacks_on(area):
        for case in attack.cases:
            if (attack.name, str(case)) not in done:
                outcome = attempt(attack, case)
                yield {
                    "attack": attack.name,
                    "case": case,
                    "survived": outcome.survived,
                    "answer": outcome.answer,
                    "cpu_seconds": f"{outcome.cpu_seconds:.1f}",
                }


def by_tests(patterns: tuple[str, ...]) -> Iterator[Row]:
    """Yield a row for each test of some files or folders, those skipped left out."""
    paths = [str(path) for p in patterns for path in sorted(Path(ROOT).glob(p))]
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder, "report.xml")
        subprocess.run(
            [sys.executable, "-m", "pytest", "-q", f"--junitxml={report}", *paths],
            cwd=ROOT,
            stdout=subprocess.DEVNULL,
            timeout=LONGEST,
            check=False,
        )
        cases = ElementTree.parse(report).getroot().iter("testcase")
    for test in cases:
        if test.find("skipped") is None:
            fault = test.find("failure")
            fault = test.find("error") if fault is None else fault
            name, _, case = test.attrib["name"].partition("[")
            yield {
                "attack": f"{test.attrib['classname']} {name}",
                "case": case.removesuffix("]"),
                "survived": fault is None,
                "answer": "" if fault is None else fault.attrib["message"][:200],
                "cpu_seconds": test.attrib["time"],
            }


def run(area: str, *, fresh: bool) -> None:
    """Run the cases of an area that have no row yet."""
    path = RESULTS / f"{area}.csv"
    if fresh:
        path.unlink(missing_ok=True)
    done = {(row["attack"], row["case"]) for row in rows_of(area)}
    patterns = AREAS[area]
    if patterns and done:
        return
    for row in by_tests(patterns) if patterns else attacked(area, done):
        append(path, [row])
        word = "survived" if row["survived"] else f"NOT: {row['answer']}"
        print(f"{area}: {row['attack']} [{row['case']}]: {word}", flush=True)


def summary() -> Iterator[str]:
    """Yield the table: tried and survived by area, then what was not survived."""
    lost: list[str] = []
    total = [0, 0]
    yield f"{'area':<20}{'attacks':>8}{'tried':>8}{'survived':>10}"
    for area in AREAS:
        rows = rows_of(area)
        bad = [row for row in rows if row["survived"] != "True"]
        lost += [f"{area}: {r['attack']} [{r['case']}]: {r['answer']}" for r in bad]
        total = [total[0] + len(rows), total[1] + len(rows) - len(bad)]
        names = {row["attack"] for row in rows}
        yield f"{area:<20}{len(names):>8}{len(rows):>8}{len(rows) - len(bad):>10}"
    yield f"{'all':<28}{total[0]:>8}{total[1]:>10}"
    yield from lost


@dataclass(frozen=True)
class Settings:
    """What is run.

    Args:
        area: Name of the area; all by default.
        fresh: Whether to run all cases again.
        summary: Whether to run nothing, and print the table of the rows.
    """

    area: Annotated[str | None, AREAS] = None
    fresh: bool = False
    summary: bool = False


def main(arguments: Settings) -> None:
    """Run what is missing and print the table."""
    areas = (arguments.area,) if arguments.area else AREAS
    for area in () if arguments.summary else areas:
        run(area, fresh=arguments.fresh)
    print("\n".join(summary()))

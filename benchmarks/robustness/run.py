"""What the library survives: an adversary's table, tried and survived by area.

    python -m benchmarks robustness
    python -m benchmarks robustness --area campaign
    python -m benchmarks robustness --summary

What was tried has become tests: an attack is a test function of an area, and a case is
what it is called with. A case is survived where the library gives the right numbers, or
the error that names the fault. No test is counted twice.

An area is run anew; ``--summary`` prints the committed rows alone.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated
from xml.etree import ElementTree

from benchmarks.rows import append, read

ROOT = Path(__file__).parents[2]
#: Areas, and the tests that hold them.
AREAS: dict[str, tuple[str, ...]] = {
    "engine": ("tests/simulation/workers", "tests/simulation/test_*.py"),
    "bank": ("tests/simulation/bank",),
    "campaign": ("tests/campaign/test_*.py",),
    "criticism": ("tests/criticism/test_*.py",),
    "effects_and_reports": ("tests/criticism/effects", "tests/criticism/report"),
    "parameters": ("tests/inference/declared", "tests/inference/emulation"),
    "threads_and_locks": tuple(
        f"tests/campaign/storage/test_{what}.py"
        for what in ("shared", "killed", "resume", "versions")
    ),
    "crafted_files": tuple(
        f"tests/campaign/storage/test_{what}.py" for what in ("damage", "codec")
    ),
    "command_line": ("tests/cli",),
    "tables": ("tests/criticism/data",),
    "mujoco_robots": ("tests/mujoco",),
    "priors": ("tests/inference/beliefs", "tests/oracles"),
    "process_state": ("tests/test_global_generators.py",),
}
RESULTS = Path(__file__).parent / "results"
LONGEST = 3_600.0  # s that all tests of an area may take


def rows_of(area: str) -> list[dict[str, str]]:
    """Return the committed rows of an area."""
    return read(RESULTS / f"{area}.csv")


def by_tests(patterns: tuple[str, ...]) -> Iterator[dict[str, object]]:
    """Yield a row for each test of some files or folders, those skipped left out."""
    paths = [str(path) for p in patterns for path in sorted(ROOT.glob(p))]
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


def run(area: str) -> None:
    """Run the tests of an area anew."""
    path = RESULTS / f"{area}.csv"
    path.unlink(missing_ok=True)
    for row in by_tests(AREAS[area]):
        append(path, [row])
        word = "survived" if row["survived"] else f"NOT: {row['answer']}"
        print(f"{area}: {row['attack']} [{row['case']}]: {word}", flush=True)


def table() -> Iterator[str]:
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


def main(
    *,
    area: Annotated[str | None, AREAS] = None,
    summary: bool = False,
) -> None:
    """Run the tests and print the table.

    Args:
        area: Name of the area; all by default.
        summary: Whether to run nothing, and print the table of the rows.
    """
    areas = (area,) if area else (*AREAS,)
    for name in () if summary else areas:
        run(name)
    print("\n".join(table()))

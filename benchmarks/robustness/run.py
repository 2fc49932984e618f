"""What the library survives: an adversary's table, tried and survived by area.

    python -m benchmarks robustness
    python -m benchmarks robustness --area campaign
    python -m benchmarks robustness --summary

Each case runs in a process of its own with a time limit, and counts as survived where
the library gives the right numbers, or the error that names the fault; a wrong number,
another error, a hang or a dead process counts as not survived. Resumable: a case that
stands in ``results/AREA.csv`` is not run again; ``--fresh`` runs an area anew.
"""

from __future__ import annotations

import csv
import importlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from benchmarks.robustness.attacks import Attack, attempt

AREAS = (
    "engine",
    "bank",
    "campaign",
    "criticism",
    "effects_and_reports",
    "parameters",
    "threads_and_locks",
    "crafted_files",
    "command_line",
    "tables",
    "mujoco_robots",
    "priors",
    "process_state",
)
RESULTS = Path(__file__).parent / "results"
COLUMNS = ["attack", "case", "survived", "answer", "cpu_seconds"]


def attacks_on(area: str) -> list[Attack]:
    """Return the attacks on an area, from the module of its name."""
    return importlib.import_module(f"benchmarks.robustness.{area}").ATTACKS


def rows_of(area: str) -> list[dict[str, str]]:
    """Return the committed rows of an area; those of attacks that are gone are not."""
    path = RESULTS / f"{area}.csv"
    if not path.exists():
        return []
    known = {(a.name, str(case)) for a in attacks_on(area) for case in a.cases}
    with path.open(newline="") as file:
        return [
            row for row in csv.DictReader(file) if (row["attack"], row["case"]) in known
        ]


def run(area: str, *, fresh: bool) -> None:
    """Run the cases of an area that have no row yet."""
    rows = [] if fresh else rows_of(area)
    done = {(row["attack"], row["case"]) for row in rows}
    RESULTS.mkdir(exist_ok=True)
    with (RESULTS / f"{area}.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
        for attack in attacks_on(area):
            for case in attack.cases:
                if (attack.name, str(case)) in done:
                    continue
                outcome = attempt(attack, case)
                writer.writerow(
                    {
                        "attack": attack.name,
                        "case": case,
                        "survived": outcome.survived,
                        "answer": outcome.answer,
                        "cpu_seconds": f"{outcome.cpu_seconds:.1f}",
                    }
                )
                file.flush()
                word = "survived" if outcome.survived else f"NOT: {outcome.answer}"
                print(f"{area}: {attack.name} [{case}]: {word}", flush=True)


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

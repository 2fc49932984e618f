"""Are bad networks and beliefs flagged, and good ones not?

    python -m benchmarks calibration --table networks --problem numerical
    python -m benchmarks calibration --table beliefs --problem square
    python -m benchmarks calibration --summary

networks: under-trained (20 to 100 steps of the paper's network on 5,000 rows), trained
(3,000 steps of the default one on 20,000; of location 5,000 steps of eight components
on 40,000, where "trained less" is as elsewhere), and trained but wrong at one action.
beliefs: refined ones, and the same twice as wide, half as wide, or without one of two
modes; "always" where every inference has the error, and ranks alone can tell.

Resumable: a row that stands in the CSV is not run again. Seeds from 2000 on judge.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from benchmarks.calibration import beliefs, networks
from benchmarks.rows import grouped, read, resumed
from sbi_active.diagnostics.verdict import clopper_pearson

RESULTS = Path(__file__).parent / "results"
TABLES = {
    "networks": (networks.network_row, networks.COLUMNS, networks.PROBLEMS),
    "beliefs": (beliefs.belief_row, beliefs.COLUMNS, beliefs.PROBLEMS),
}
KINDS = {
    "networks": ("under", "trained", "trained less", "one action"),
    "beliefs": beliefs.KINDS,
}


def path(table: str) -> Path:
    """Return the file of a table."""
    return RESULTS / f"{table}.csv"


def run(table: str, problem: str, kind: str, seeds: range) -> None:
    """Run the seeds that are not there yet."""
    make, columns, _ = TABLES[table]
    keys, jobs = ["problem", "kind", "seed"], [(problem, kind, s) for s in seeds]
    resumed(path(table), keys, jobs, make, columns=columns)


def summary(table: str, first: int) -> None:
    """Print the share flagged, by problem and kind."""
    judged = [r for r in read(path(table)) if int(r["seed"]) >= first]
    for (problem, kind), rows in grouped(judged, "problem", "kind").items():
        n = len(rows)
        k = sum(row["verdict"] != "trust" for row in rows)
        low, high = clopper_pearson(k, n, 0.05)
        cpu = sum(float(row["cpu_seconds"]) for row in rows) / n
        line = f"{problem:12s} {kind:14s} flagged {k}/{n} ({low:.2f} to {high:.2f})"
        if kind == "one action":
            at = sum(int(row["wrong_flagged"]) for row in rows)
            only = sum(
                row["wrong_flagged"] == "1" and row["others_flagged"] == "0"
                for row in rows
            )
            line += f", at the wrong action {at}, only there {only}"
        print(f"{line}; {cpu:.1f} CPU s")


@dataclass(frozen=True)
class Settings:
    """What is run.

    Args:
        table: Name of the table.
        problem: Names of the problems.
        kind: Kind of cases; all by default.
        first: Number of the first case.
        seeds: Number of seeds.
        summary: Whether to run nothing, and print the table of the rows.
    """

    table: Annotated[str, TABLES] = "networks"
    problem: Sequence[str] | None = None
    kind: Sequence[str] | None = None
    first: int = 2_000
    seeds: int = 40
    summary: bool = False


def main(given: Settings) -> None:
    """Run what is asked for and print the table."""
    if given.summary:
        for table in TABLES:
            summary(table, given.first)
        return
    for problem in given.problem or [*TABLES[given.table][2]][:3]:
        for kind in given.kind or KINDS[given.table]:
            if kind == "trained less" and problem != "location":
                continue  # as trained
            run(
                given.table,
                problem,
                kind,
                range(given.first, given.first + given.seeds),
            )
    summary(given.table, given.first)

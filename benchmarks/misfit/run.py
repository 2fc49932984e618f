"""The closed loop where every model is wrong, on worlds whose truth is known.

    python -m benchmarks misfit --group own --kind E --first 1000 --cases 40
    python -m benchmarks misfit --group letters --first 1000 --cases 40
    python -m benchmarks misfit --summary --first 1000

Machines have a declared sensor, wide priors, about nine declared effects, and a smooth
discrepancy of 2 to 10 sensor deviations that nobody declared. Kinds: E, an effect
beside it; R, the same with the effect removed from the library; M, the discrepancy
alone; P, a fast and a slow effect beside it; C, clean; CE, an effect alone. Groups: own
(pendulum, driven spring, tanks; 10 trials of 20 samples and 6 of 30 by turns) and
letters (worlds A, B, C of the benchmark of criticism with a discrepancy).

Seeds are the numbers of cases. **Those below 1,000 are for tuning; those from 1,000 on
judge**: they have other undeclared forms, and rough processes besides, and nothing may
be tuned on them.

Resumable: a case that stands in the CSV is not run again. One row a case, one file a
group and kind, in benchmarks/misfit/results. Give each command a core of its own
(OMP_NUM_THREADS=1) and another --first, which writes its own file.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from benchmarks.misfit.cases import FIRST_JUDGED, KINDS, Kind, draw_case
from benchmarks.misfit.machines import GROUPS
from benchmarks.misfit.scores import score_case
from benchmarks.misfit.summary import summary
from benchmarks.rows import read, resumed

RESULTS = Path(__file__).parent / "results"


def run_kind(group: str, kind: Kind, first: int, cases: int) -> None:
    """Run the cases that are in none of the files yet."""
    path = RESULTS / f"{group}_{kind}_from_{first}.csv"

    def made(number: int) -> dict[str, object]:
        return score_case(draw_case(group, kind, number), number)

    numbers = [(number,) for number in range(first, first + cases)]
    others = [*RESULTS.glob(f"{group}_{kind}_from_*.csv")]
    resumed(path, ["case"], numbers, made, others=others)


def rows_of(group: str, kind: str) -> list[dict[str, str]]:
    """Return the rows of all files of a group and kind."""
    files = sorted(RESULTS.glob(f"{group}_{kind}_from_*.csv"))
    return [row for file in files for row in read(file)]


@dataclass(frozen=True)
class Settings:
    """What is run.

    Args:
        group: Group of worlds; all by default.
        kind: Kind of cases; all by default.
        first: Number of the first case.
        cases: Number of cases.
        summary: Whether to run nothing, and print the table of the rows.
    """

    group: Annotated[str | None, GROUPS] = None
    kind: Kind | None = None
    first: int = FIRST_JUDGED
    cases: int = 40
    summary: bool = False


def main(arguments: Settings) -> None:
    """Run what is asked for and print the summary."""
    groups = (arguments.group,) if arguments.group else (*GROUPS,)
    kinds = (arguments.kind,) if arguments.kind else KINDS
    is_judged = arguments.first >= FIRST_JUDGED
    seeds, pooled = "judging" if is_judged else "tuning", []
    for group in groups:
        rows = []
        for kind in kinds:
            if not arguments.summary:
                run_kind(group, kind, arguments.first, arguments.cases)
            every = rows_of(group, kind)
            rows += [r for r in every if (int(r["case"]) >= FIRST_JUDGED) == is_judged]
        pooled += rows
        if rows:
            print(f"\n## {group}, {seeds} seeds", *summary(rows), sep="\n")
    if len(groups) > 1 and pooled:
        print(f"\n## {' and '.join(groups)}, {seeds} seeds", *summary(pooled), sep="\n")

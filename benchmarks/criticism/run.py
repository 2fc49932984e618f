"""The closed loop on worlds whose truth is known, one table a command.

    python -m benchmarks criticism --table loop --world A --trials 8 --cases 200
    python -m benchmarks criticism --table loop --world B --kind clean --cases 40
    python -m benchmarks criticism --table open --world A --trials 12 --cases 100
    python -m benchmarks criticism --table pairs --world B --trials 12 --cases 60
    python -m benchmarks criticism --table active --world B --trials 10 --cases 40
    python -m benchmarks criticism --table loop --world D --kind library --cases 60
    python -m benchmarks criticism --table loop --world A --summary

loop: false alarms, power, tracing, calibration, error before and after. open: the
effect was removed from the library, or removed with all that could stand in for it, or
never stood in it. pairs: two effects. active:
actions chosen by the loop beside random ones.

Resumable: a case that stands in the CSV is not run again. One row a case, one file a
setting, in benchmarks/criticism/results. Give each command a core of its own
(OMP_NUM_THREADS=1); ``--first`` splits cases over processes, each writing its own file.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from benchmarks.criticism import tables
from benchmarks.criticism.active import score_active
from benchmarks.criticism.cases import KINDS, draw_case
from benchmarks.criticism.scores import score_case
from benchmarks.criticism.worlds import get_world
from benchmarks.rows import read, resumed

RESULTS = Path(__file__).parent / "results"
#: Which kinds of cases a table is made of.
TABLES: dict[str, tuple[str, ...]] = {
    "loop": ("clean", "library"),
    "open": ("removed", "inexpressible", "outside"),
    "pairs": ("pair",),
    "active": ("library",),
}


@dataclass(frozen=True)
class Settings:
    """What is run.

    Args:
        table: Name of the table.
        world: Name of the world.
        kind: Kind of cases; all by default.
        trials: Number of trials.
        cases: Number of cases.
        first: Number of the first case.
        summary: Whether to run nothing, and print the table of the rows.
    """

    table: Annotated[str, TABLES] = "loop"
    world: Literal["A", "B", "C", "D"] = "A"
    kind: Annotated[str | None, KINDS] = None
    trials: int = 8
    cases: int = 200
    first: int = 0
    summary: bool = False


def paths(arguments: Settings, kind: str) -> list[Path]:
    """Return the setting's file, then those of processes with another first case."""
    name = f"{arguments.world}_{kind}_{arguments.trials}"
    name += "_active" if arguments.table == "active" else ""
    mine = f"{name}_from_{arguments.first}" if arguments.first else name
    others = sorted({RESULTS / f"{name}.csv", *RESULTS.glob(f"{name}_from_*.csv")})
    return [RESULTS / f"{mine}.csv", *others]


def run_setting(arguments: Settings, kind: str) -> None:
    """Run the cases that are in none of the files yet."""
    world = get_world(arguments.world)
    is_active = arguments.table == "active"

    def made(number: int) -> Any:
        case = draw_case(
            world,
            kind,  # type: ignore[arg-type]  # checked by the parser
            number,
            num_trials=arguments.trials,
        )
        if is_active:
            return score_active(case, number)
        oracle = kind == "library" and case.truth.effects[0].hook != "noise"
        return score_case(case, number, oracle=oracle and not world.is_rough)

    path, *others = paths(arguments, kind)
    last = arguments.first + arguments.cases
    resumed(
        path,
        ["case"],
        [(number,) for number in range(arguments.first, last)],
        made,
        others=others,
    )


def main(arguments: Settings) -> None:
    """Run what is asked for and print its table."""
    found: dict[str, list[dict[str, str]]] = {}
    for kind in (arguments.kind,) if arguments.kind else TABLES[arguments.table]:
        if not arguments.summary:
            run_setting(arguments, kind)
        _, *files = paths(arguments, kind)
        found[kind] = [row for file in files for row in read(file)]
    world = get_world(arguments.world)
    for line in tables.summary(arguments.table, world, found):
        print(line)

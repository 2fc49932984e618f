"""The closed loop on worlds whose truth is known, one table a command.

    python -m benchmarks criticism --world A                  # clean and library sets
    python -m benchmarks criticism --world A --kind removed --cases 0 100
    python -m benchmarks criticism --world B --kind pair --cases 0 40
    python -m benchmarks criticism --world A --kind active --cases 0 60
    python -m benchmarks criticism --world A --summary

clean and library: false alarms, power, tracing, calibration, error before and after.
removed, inexpressible, outside: the effect was removed from the library, or removed
with all that could stand in for it, or never stood in it. pair: two effects. active:
actions chosen by the loop beside random ones.

Resumable: a case that stands in the CSV is not run again. One row a case, one file a
world and kind, in benchmarks/criticism/results. Give each command a core of its own
(OMP_NUM_THREADS=1).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from benchmarks.criticism.active import score_active
from benchmarks.criticism.cases import KINDS, draw_case
from benchmarks.criticism.scores import score_case
from benchmarks.criticism.tables import summary
from benchmarks.criticism.worlds import WORLDS, get_world
from benchmarks.rows import benchmark

#: Trials to fit, where they are not eight.
NUM_TRIALS = dict.fromkeys(("removed", "inexpressible", "outside", "pair"), 12)


def rows_of(name: str, kind: Any, number: int) -> Any:
    """Return the row of a case, or those of chosen and of random trials."""
    world, is_active = get_world(name), kind == "active"
    drawn = "library" if is_active else kind
    case = draw_case(world, drawn, number, num_trials=NUM_TRIALS.get(kind, 8))
    if is_active:
        return score_active(case, number)
    oracle = kind == "library" and case.truth.effects[0].hook != "noise"
    return score_case(case, number, oracle=oracle and not world.is_rough)


main = benchmark(
    Path(__file__).parent / "results" / "{world}_{kind}.csv",
    rows_of,
    summary,
    may_fail=True,
    default={"world": ("A",), "kind": ("clean", "library")},
    world=WORLDS,
    kind=(*KINDS, "active"),
    case=range(200),
)

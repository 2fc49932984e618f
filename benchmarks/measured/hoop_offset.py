"""What the ball and hoop's verdict owes to the prior of the offset of its input.

    python -m benchmarks measured.hoop_offset --data DIR

The hoop turns one way only in the samples that are fitted, so that dry friction and a
dead zone are an offset of the input there. The verdict on the whole library, as in
:mod:`benchmarks.measured.ball_and_hoop`, for three deviations of the offset's prior
and three densities of the readings. Rows stand in ``results/hoop_offset.json``; what
is missing is run.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from benchmarks.measured.ball_and_hoop import make_bench
from benchmarks.measured.record_stages import judge, said
from benchmarks.rows import add, measured, stages
from sbi_active.display.table import Table
from sbi_active.tasks.ball_and_hoop import DATA, make_prior, read_recordings  # pyright: ignore

RESULT = Path(__file__).parent / "results" / "hoop_offset.json"
SDS = (0.01, 0.02, 0.05)  # V; the first is the task's
#: Readings of the pieces that are kept: one in 1, .5 and .3 s.
EVERY = (10, 5, 3)


def table(rows: dict[str, dict[str, Any]]) -> str:
    """Return the rows in Markdown."""
    first = next(iter(rows.values()))
    header = ("prior of the offset, V", "a reading in, s", "verdict")
    held_out = f"held out, V: {' / '.join(first['after'])}"
    lines = []
    for row in rows.values():
        after = " / ".join(f"{e:.3f}" for e in row["after"].values())
        prior, every = f"{row['offset_sd']:g}", f"{0.1 * row['every']:.1f}"
        lines.append((prior, every, said(row), after, f"{row['cpu_seconds']:.0f}"))
    return Table((*header, held_out, "CPU s"), lines).markdown()


def main(*, data: Path = DATA) -> None:
    """Run what is missing from the results, and print the table.

    Args:
        data: Folder of the measured set.
    """
    rows = stages(RESULT)
    wanted = {f"{sd:g} {every}": (sd, every) for sd in SDS for every in EVERY}
    missing = {name: pair for name, pair in wanted.items() if name not in rows}
    records = measured(read_recordings, data) if missing else {}
    for name, (sd, every) in missing.items():
        bench = make_bench(records, every=every)
        row = judge(replace(bench, prior=make_prior(offset_sd=sd)))
        add(RESULT, rows, name, {"offset_sd": sd, "every": every, **row})
    print(table({name: rows[name] for name in wanted}))

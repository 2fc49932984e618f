"""The cascaded tanks: what Torricelli's law lacks, from two records.

    python -m benchmarks measured.cascaded_tanks --data DIR
    python -m benchmarks measured.cascaded_tanks --data DIR --clean 0 --reports reports

``DIR`` holds ``estimation.csv`` and ``validation.csv``. The first is fitted, in six
trials of 600 s that run for 400 s before; the second is scored after its first 50
samples, on which its start levels are found. Stages stand in
:mod:`benchmarks.measured.record_stages`; each is added to
``results/cascaded_tanks.json`` unless it is there, and the tables are printed. Least
squares fits the same pieces, and beside them the first record as a whole.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from benchmarks.measured.record_stages import (
    Bench,
    Settings,
    as_row,
    run_settings,
    with_error,
)
from benchmarks.measured.tanks_least_squares import (
    fit_pieces,
    fit_tanks,
    run_pieces,
    score,
)
from sbi_active.criticism import Trials
from sbi_active.tasks import cascaded_tanks  # pyright: ignore
from sbi_active.tasks.cascaded_tanks import split  # pyright: ignore
from sbi_active.tasks.cascaded_tanks.model import SENSOR_SD  # pyright: ignore
from sbi_active.tasks.cascaded_tanks.recordings import (  # pyright: ignore
    EVERY,
    LEAD,
    LENGTH,
    SLOPE,
)
from sbi_active.tasks.records import Record, cut  # pyright: ignore

__all__ = ["main", "make_bench"]

RESULT = Path(__file__).parent / "results" / "cascaded_tanks.json"
CHANNEL = "level [V]"
LABELS = ("begin [s]", "start [V]", "slope [V/s]")
REMOVALS = (
    ("overflow",),
    ("linear outflow",),
    ("overflow", "sensor saturation"),
    ("overflow", "linear outflow"),
    ("linear outflow", "outflow exponent"),
    ("linear outflow", "outflow exponent", "pump dead zone"),
    ("overflow", "linear outflow", "outflow exponent"),
    ("overflow", "sensor saturation", "linear outflow", "outflow exponent"),
)
#: Effects that least squares is given in any case.
GIVEN = (
    ("overflow",),
    ("linear outflow",),
    ("overflow", "linear outflow"),
    ("overflow", "outflow exponent"),
)


def make_bench(records: dict[str, Record], *, every: int = EVERY) -> Bench:
    """Return the machine.

    Args:
        records: Of ``read_recordings``.
        every: Readings of the fitted pieces that are kept.
    """
    pieces, scored = split(records, every=every)
    fitted = records["estimation"]

    def least_squares(names: tuple[str, ...]) -> dict[str, Any]:
        fit, effects = fit_pieces(pieces, names)
        whole, _ = fit_tanks(fitted, names)
        own = torch.from_numpy(fit.parameters)[None]
        row = as_row(fit, score(own, scored, effects))
        own = torch.from_numpy(whole.parameters[:-2])[None]
        return row | {"as one record": as_row(whole, score(own, scored, effects))}

    def replay(seed: int, names: tuple[str, ...]) -> Trials:
        fit, effects = fit_tanks(fitted, names)
        z = torch.from_numpy(fit.parameters)[None]
        whole = cut(fitted, len(fitted) - 1, slope=SLOPE)
        x = run_pieces(z[:, :-2], z[:, None, -2:], whole, effects)[0, 0]
        x = torch.cat([torch.from_numpy(whole.start) + z[0, -1:], x])
        output = with_error(x, SENSOR_SD, seed)
        made = Record("replay", fitted.step, fitted.voltage, output)
        pieces = cut(made, LENGTH, every=every, slope=SLOPE, lead=LEAD)
        return pieces.trials(LABELS, CHANNEL)

    return Bench.of(
        cascaded_tanks,
        trials=pieces.trials(LABELS, CHANNEL),
        removals=REMOVALS,
        given=GIVEN,
        score=lambda draws, effects: score(draws, scored, effects),
        least_squares=least_squares,
        replay=replay,
    )


def main(settings: Settings) -> int:
    """Run the stages that are missing from the results, and print the tables."""
    return run_settings(settings, cascaded_tanks, make_bench, RESULT)

"""The ball and hoop: what a motor of first order lacks, from three records.

    python -m benchmarks measured.ball_and_hoop --data DIR
    python -m benchmarks measured.ball_and_hoop --data DIR --clean 0 --reports reports

``DIR`` holds ``random_steps.csv``, ``fixed_steps.csv`` and ``closed_loop.csv``. The
first 3,000 samples of the first are fitted, in ten trials of 30 s that start at a speed
that was read; its rest and the other two are predicted in free run, from their first
reading on. Stages stand in :mod:`benchmarks.measured.record_stages`; each is added to
``results/ball_and_hoop.json`` unless it is there, and the tables are printed.

What the fitted samples cannot tell: the hoop turns one way only in them, so that
Coulomb friction is an offset of the input. A fit that is free to choose both can put
them anywhere on a line, with one error on what was fitted and any on what was not: with
Coulomb friction alone, plain least squares gets 2.5 to 5.5 V on the rest of the first
record. The prior of the offset, 1 % of the largest command, is what decides
(:mod:`benchmarks.measured.hoop_offset`). Least squares is therefore given with the
offset at zero, and with the offset free beside it.

Besides friction the library has an amplifier whose gain falls with the command. Least
squares given it alone fits better than given quadratic drag and Coulomb friction, and
predicts the three records better. ``without compression`` is the library of friction
alone.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from benchmarks.measured.hoop_least_squares import fit_hoop, free_run, run_pieces
from benchmarks.measured.record_stages import (
    Bench,
    Settings,
    as_row,
    run_settings,
    with_error,
)
from sbi_active.criticism import Trials
from sbi_active.tasks import ball_and_hoop  # pyright: ignore
from sbi_active.tasks.ball_and_hoop import split  # pyright: ignore
from sbi_active.tasks.ball_and_hoop.model import SENSOR_SD  # pyright: ignore
from sbi_active.tasks.ball_and_hoop.recordings import (  # pyright: ignore
    EVERY,
    FITTED,
    LENGTH,
)
from sbi_active.tasks.records import Record, cut  # pyright: ignore

__all__ = ["main", "make_bench"]

RESULT = Path(__file__).parent / "results" / "ball_and_hoop.json"
CHANNEL = "speed [V]"
LABELS = ("begin [s]", "start [V]")
REMOVALS = (
    ("quadratic drag",),
    ("Coulomb",),
    ("compression",),
    ("compression", "Coulomb"),
    ("compression", "stiction"),
    ("compression", "quadratic drag"),
    ("compression", "cubic drag"),
    ("compression", "quadratic drag", "cubic drag"),
)
#: Effects that least squares is given in any case.
GIVEN = (
    ("quadratic drag",),
    ("Coulomb",),
    ("Coulomb", "quadratic drag"),
    ("compression",),
    ("quadratic drag", "compression"),
)


def make_bench(records: dict[str, Record], *, every: int = EVERY) -> Bench:
    """Return the machine.

    Args:
        records: Of ``read_recordings``.
        every: Readings of the fitted pieces that are kept.
    """
    pieces, held = split(records, every=every)
    fitted = records["random_steps"]

    def least_squares(names: tuple[str, ...]) -> dict[str, Any]:
        free, effects = fit_hoop(fitted, names)
        zero, _ = fit_hoop(fitted, names, offset=0.0)
        own = torch.from_numpy(zero.parameters)[None]
        row = as_row(zero, free_run(own, held, effects))
        own = torch.from_numpy(free.parameters)[None]
        return row | {"offset free": as_row(free, free_run(own, held, effects))}

    def replay(seed: int, names: tuple[str, ...]) -> Trials:
        fit, effects = fit_hoop(fitted, names, offset=0.0)
        whole = cut(fitted.part(0, FITTED + 1), FITTED)
        x = run_pieces(torch.from_numpy(fit.parameters)[None], whole, effects)[0, 0]
        x = torch.cat([torch.from_numpy(whole.start), x])
        output = with_error(x, SENSOR_SD, seed)
        made = Record("replay", fitted.step, fitted.voltage[: FITTED + 1], output)
        return cut(made, LENGTH, every=every).trials(LABELS, CHANNEL)

    return Bench.of(
        ball_and_hoop,
        trials=pieces.trials(LABELS, CHANNEL),
        removals=REMOVALS,
        given=GIVEN,
        score=lambda draws, effects: free_run(draws, held, effects),
        least_squares=least_squares,
        replay=replay,
    )


def main(settings: Settings) -> int:
    """Run the stages that are missing from the results, and print the tables."""
    return run_settings(settings, ball_and_hoop, make_bench, RESULT)

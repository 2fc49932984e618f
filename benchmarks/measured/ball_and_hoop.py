"""The ball and hoop: what a motor of first order lacks, from three records.

    python -m benchmarks measured.ball_and_hoop --data DIR

``DIR`` holds ``random_steps.csv``, ``fixed_steps.csv`` and ``closed_loop.csv``. The
first 3,000 samples of the first are fitted, in ten trials of 30 s that start at a speed
that was read; its rest and the other two are predicted in free run, from their first
reading on. Stages stand in :mod:`benchmarks.measured.record_stages`; each is added to
``results/ball_and_hoop.json`` unless it is there, and the tables are printed.

What the fitted samples cannot tell: the hoop turns one way only in them, so that
Coulomb friction is an offset of the input. A fit that is free to choose both can put
them anywhere on a line, with one error on what was fitted and any on what was not: with
Coulomb friction alone, plain least squares gets 2.5 to 5.5 V on the rest of the first
record. The prior of the offset, 1 % of the largest command, is what decides (a table in
``hoop.md``). Least squares is therefore given with the offset at zero.

Besides friction the library has an amplifier whose gain falls with the command. Least
squares given it alone fits better than given quadratic drag and Coulomb friction, and
predicts the three records better. ``without compression`` is the library of friction
alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.fitting import Fit, effect_bounds, fit_record, run_rows
from benchmarks.measured.record_stages import Bench, stages_of, with_error
from sbi_active.criticism import Effect, Trials
from sbi_active.tasks import ball_and_hoop  # pyright: ignore
from sbi_active.tasks.ball_and_hoop import make_effects, spin, split  # pyright: ignore
from sbi_active.tasks.ball_and_hoop.model import DAMPING, DRIVE, SENSOR_SD  # pyright: ignore
from sbi_active.tasks.ball_and_hoop.recordings import EVERY, FITTED, LENGTH  # pyright: ignore
from sbi_active.tasks.records import Pieces, Record, cut  # pyright: ignore

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


def run_pieces(
    parameters: Tensor, pieces: Pieces, effects: Sequence[Effect] = ()
) -> Tensor:
    """Return predictions, shape (n, t, k).

    Args:
        parameters: Theta and strengths, shape (n, 3 + d), float64.
        pieces: The t pieces.
        effects: Whose strengths they are, all of them keyword arguments.
    """
    return run_rows(spin, parameters, pieces, effects, 3)


def free_run(
    parameters: Tensor, held_out: dict[str, Pieces], effects: Sequence[Effect] = ()
) -> dict[str, float]:
    """Return the root mean square error of the mean prediction of each record, V.

    Args:
        parameters: Draws or one fit, shape (n, 3 + d).
        held_out: Records in one piece each.
        effects: As for :func:`run_pieces`.
    """
    found = {}
    for name, record in held_out.items():
        x = run_pieces(parameters, record, effects).mean(0).numpy()
        found[name] = float(np.sqrt(((x - record.output) ** 2).mean()))
    return found


def fit_hoop(
    record: Record,
    names: Sequence[str] = (),
    *,
    offset: float,
) -> tuple[Fit, list[Effect]]:
    """Return the fit of the first 3,000 samples in ten pieces, and the effects.

    All readings count, ten a second. As one record they give the same to a per cent,
    in ten times the time.

    Args:
        record: Record ``random_steps``.
        names: Names of the effects.
        offset: Offset of the input, V.
    """
    whole = cut(record.part(0, FITTED + 1), LENGTH)
    effects = [effect for effect in make_effects() if effect.name in names]
    least, most = effect_bounds(effects)

    def complete(z: Tensor) -> Tensor:
        held = torch.full((len(z), 1), offset, dtype=z.dtype)
        return torch.cat([z[:, :2], held, z[:, 2:]], 1)

    found = fit_record(
        lambda z: run_pieces(complete(z), whole, effects).flatten(1),
        torch.from_numpy(whole.output).flatten(),
        [DRIVE[0], DAMPING[0], *least],
        [DRIVE[1], DAMPING[1], *most],
    )
    z = complete(torch.from_numpy(found.parameters)[None])[0].numpy()
    return Fit(z, found.rmse), effects


def make_bench(records: dict[str, Record], *, every: int = EVERY) -> Bench:
    """Return the machine.

    Args:
        records: Records of ``read_recordings``.
        every: Stride of the readings of the fitted pieces that are kept.
    """
    pieces, held = split(records, every=every)
    fitted = records["random_steps"]

    def least_squares(names: tuple[str, ...]) -> dict[str, Any]:
        zero, effects = fit_hoop(fitted, names, offset=0.0)
        own = torch.from_numpy(zero.parameters)[None]
        return zero.row(free_run(own, held, effects))

    def replay(seed: int) -> Trials:
        fit, _ = fit_hoop(fitted, offset=0.0)
        whole = cut(fitted.part(0, FITTED + 1), FITTED)
        x = run_pieces(torch.from_numpy(fit.parameters)[None], whole)[0, 0]
        x = torch.cat([torch.from_numpy(whole.start), x])
        output = with_error(x, SENSOR_SD, seed)
        made = Record("replay", fitted.step, fitted.voltage[: FITTED + 1], output)
        return cut(made, LENGTH, every=every).trials(LABELS, CHANNEL)

    return Bench.of(
        ball_and_hoop,
        trials=pieces.trials(LABELS, CHANNEL),
        removals=REMOVALS,
        score=lambda draws, effects: free_run(draws, held, effects),
        least_squares=least_squares,
        replay=replay,
    )


main = stages_of(ball_and_hoop, make_bench, RESULT)

"""The cascaded tanks: what Torricelli's law lacks, from two records.

    python -m benchmarks measured.cascaded_tanks --data DIR

``DIR`` holds ``estimation.csv`` and ``validation.csv``. The first is fitted, in six
trials of 600 s that run for 400 s before; the second is scored after its first 50
samples, on which its start levels are found. Stages stand in
:mod:`benchmarks.measured.record_stages`; each is added to
``results/cascaded_tanks.json`` unless it is there, and the tables are printed. Least
squares fits the same pieces.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks.fitting import Fit, batched_fits, effect_bounds, fit_record, run_rows
from benchmarks.measured.record_stages import Bench, stages_of, with_error
from sbi_active.criticism import Effect, Trials
from sbi_active.tasks import cascaded_tanks  # pyright: ignore
from sbi_active.tasks.cascaded_tanks import FOUND_ON, levels, make_effects, split  # pyright: ignore
from sbi_active.tasks.cascaded_tanks.model import PRIOR_HIGH, PRIOR_LOW, SENSOR_SD  # pyright: ignore
from sbi_active.tasks.cascaded_tanks.recordings import EVERY, LEAD, LENGTH, SLOPE  # pyright: ignore
from sbi_active.tasks.records import Pieces, Record, cut  # pyright: ignore

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
#: Of the start levels beside what the first readings tell, V.
START_LOW, START_HIGH = (-10.0, -1.0), (10.0, 1.0)


def run_pieces(
    parameters: Tensor, starts: Tensor, pieces: Pieces, effects: Sequence[Effect] = ()
) -> Tensor:
    """Return predictions, shape (n, t, k).

    Args:
        parameters: Theta and strengths, shape (n, 4 + d), float64.
        starts: Of both levels beside what the first readings tell, shape (n, t, 2), V.
        pieces: The t pieces.
        effects: Whose strengths they are, all of them keyword arguments.
    """
    upper, lower = starts.reshape(-1, 2).unbind(1)
    start = {"upper_start": upper, "lower_start": lower}
    return run_rows(levels, parameters, pieces, effects, 4, **start)


def score(
    parameters: Tensor, scored: Pieces, effects: Sequence[Effect] = ()
) -> dict[str, float]:
    """Return the root mean square error of the mean prediction of a record, V.

    The start levels are found on the first 50 samples, for each row of the parameters,
    and the record is scored after these.

    Args:
        parameters: Draws or one fit, shape (n, 4 + d).
        scored: In one piece.
        effects: As for :func:`run_pieces`.
    """
    known = FOUND_ON - 1  # readings after the first
    begin = replace(
        scored,
        voltage=scored.voltage[:, :FOUND_ON],
        times=scored.times[:known],
        output=scored.output[:, :known],
    )
    num = len(parameters)

    def predict(z: Tensor) -> Tensor:
        own = parameters.repeat_interleave(len(z) // num, 0)
        return run_pieces(own, z[:, None], begin, effects).flatten(1)

    def row(*values: float) -> Tensor:
        return torch.tensor(values, dtype=torch.float64)

    best, least = None, torch.full((num,), torch.inf, dtype=torch.float64)
    for upper in (-3.0, 0.0, 3.0):
        z, residual = batched_fits(
            predict,
            torch.from_numpy(begin.output).expand(num, -1),
            row(upper, 0.0).expand(num, 2),
            low=row(*START_LOW),
            high=row(*START_HIGH),
            scale=row(1.0, 1.0),
            weak=row(torch.inf, torch.inf),
        )
        cost = residual.square().sum(1)
        best = z if best is None else torch.where((cost < least)[:, None], z, best)
        least = torch.minimum(cost, least)
    assert best is not None
    x = run_pieces(parameters, best[:, None], scored, effects).mean(0)[0]
    error = x - torch.from_numpy(scored.output[0])
    return {"validation": float(error[known:].square().mean().sqrt())}


def fit_pieces(pieces: Pieces, names: Sequence[str]) -> tuple[Fit, list[Effect]]:
    """Return the fit of pieces that run before they are read, and the effects.

    Args:
        pieces: To fit.
        names: Names of the effects.

    Returns:
        Parameters are theta and the strengths.
    """
    effects = [effect for effect in make_effects() if effect.name in names]
    least, most = effect_bounds(effects)
    known = torch.from_numpy(pieces.output).isfinite()

    def predict(z: Tensor) -> Tensor:
        starts = torch.zeros(len(z), len(pieces), 2, dtype=torch.float64)
        return run_pieces(z, starts, pieces, effects)[:, known]

    low, high = [*PRIOR_LOW, *least], [*PRIOR_HIGH, *most]
    target = torch.from_numpy(pieces.output)[known]
    return fit_record(predict, target, low, high), effects


def fit_tanks(
    record: Record, names: Sequence[str] = (), *, starts: int = 6
) -> tuple[Fit, list[Effect]]:
    """Return the fit of the whole record with both start levels, and the effects.

    Args:
        record: Record ``estimation``.
        names: Names of the effects.
        starts: Number of local fits.

    Returns:
        Parameters are theta, the strengths, and the two start levels beside the first
        reading.
    """
    whole = cut(record, len(record) - 1, slope=SLOPE)
    effects = [effect for effect in make_effects() if effect.name in names]
    least, most = effect_bounds(effects)
    found = fit_record(
        lambda z: run_pieces(z[:, :-2], z[:, None, -2:], whole, effects).flatten(1),
        torch.from_numpy(whole.output[0]),
        [*PRIOR_LOW, *least, *START_LOW],
        [*PRIOR_HIGH, *most, *START_HIGH],
        starts=starts,
    )
    return found, effects


def make_bench(records: dict[str, Record], *, every: int = EVERY) -> Bench:
    """Return the machine.

    Args:
        records: Records of ``read_recordings``.
        every: Stride of the readings of the fitted pieces that are kept.
    """
    pieces, scored = split(records, every=every)
    fitted = records["estimation"]

    def least_squares(names: tuple[str, ...]) -> dict[str, Any]:
        fit, effects = fit_pieces(pieces, names)
        own = torch.from_numpy(fit.parameters)[None]
        return fit.row(score(own, scored, effects))

    def replay(seed: int) -> Trials:
        fit, _ = fit_tanks(fitted)
        z = torch.from_numpy(fit.parameters)[None]
        whole = cut(fitted, len(fitted) - 1, slope=SLOPE)
        x = run_pieces(z[:, :-2], z[:, None, -2:], whole)[0, 0]
        x = torch.cat([torch.from_numpy(whole.start) + z[0, -1:], x])
        output = with_error(x, SENSOR_SD, seed)
        made = Record("replay", fitted.step, fitted.voltage, output)
        pieces = cut(made, LENGTH, every=every, slope=SLOPE, lead=LEAD)
        return pieces.trials(LABELS, CHANNEL)

    return Bench.of(
        cascaded_tanks,
        trials=pieces.trials(LABELS, CHANNEL),
        removals=REMOVALS,
        score=lambda draws, effects: score(draws, scored, effects),
        least_squares=least_squares,
        replay=replay,
    )


main = stages_of(cascaded_tanks, make_bench, RESULT)

"""Plain least squares of the ball and hoop, and its error in free run."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from benchmarks.measured.record_least_squares import (
    Fit,
    effect_bounds,
    fit_record,
    run_rows,
)
from sbi_active.criticism import Effect
from sbi_active.tasks.ball_and_hoop import make_effects, spin  # pyright: ignore
from sbi_active.tasks.ball_and_hoop.model import DAMPING, DRIVE  # pyright: ignore
from sbi_active.tasks.ball_and_hoop.recordings import (  # pyright: ignore
    FITTED,
    LENGTH,
)
from sbi_active.tasks.records import Pieces, Record, cut  # pyright: ignore

__all__ = ["fit_hoop", "free_run", "run_pieces"]

#: Of the offset, V, where it is fitted: far beyond an amplifier's.
OFFSET = 0.5


def run_pieces(
    parameters: Tensor, pieces: Pieces, effects: Sequence[Effect] = ()
) -> Tensor:
    """Return predictions, shape (n, t, k).

    Args:
        parameters: Theta and strengths, shape (n, 3 + d), float64.
        pieces: t of them.
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
    offset: float | None = None,
    seed: int = 0,
) -> tuple[Fit, list[Effect]]:
    """Return the fit of the first 3,000 samples in ten pieces, and the effects.

    All readings count, ten a second. As one record they give the same to a per cent,
    in ten times the time.

    Args:
        record: ``random_steps``.
        names: Of the effects.
        offset: Of the input, V; None fits it too.
        seed: Of the starts.
    """
    whole = cut(record.part(0, FITTED + 1), LENGTH)
    effects = [effect for effect in make_effects() if effect.name in names]
    least, most = effect_bounds(effects)
    edge = (-OFFSET, OFFSET) if offset is None else (offset, offset)
    low = [DRIVE[0], DAMPING[0], *([edge[0]] if offset is None else []), *least]
    high = [DRIVE[1], DAMPING[1], *([edge[1]] if offset is None else []), *most]

    def complete(z: Tensor) -> Tensor:
        if offset is None:
            return z
        held = torch.full((len(z), 1), offset, dtype=z.dtype)
        return torch.cat([z[:, :2], held, z[:, 2:]], 1)

    found = fit_record(
        lambda z: run_pieces(complete(z), whole, effects).flatten(1),
        torch.from_numpy(whole.output).flatten(),
        low,
        high,
        seed=seed,
    )
    z = complete(torch.from_numpy(found.parameters)[None])[0].numpy()
    return Fit(z, found.rmse), effects

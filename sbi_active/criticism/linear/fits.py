"""Least-squares fits of one model, a dozen simulations each.

A fit follows secants from where it starts, and ends with derivatives at its own best
fit, which whatever is linear rests on.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sbi_active.criticism.linear.model import LinearModel, linearize
from sbi_active.criticism.linear.settings import FitSettings
from sbi_active.criticism.rivals.rival import Rival
from sbi_active.inference.sampling.least_squares import descend

Array = NDArray[Any]


def best_fit(rival: Rival, u: Array, unit: Array, settings: FitSettings) -> LinearModel:
    """Return a model linearized at the best fit that searches from draws find.

    Half of them begin at the best draws, half at some of the others.

    Args:
        rival: The model.
        u: Draws of its prior, shape (n, d).
        unit: Standard deviation of each number's error, shape (N,).
        settings: Settings of what is spent.
    """
    own = settings
    r = rival.residual(u)[0] / unit
    order = np.argsort((r**2).sum(1))
    half = own.num_starts // 2
    far = order[half :: own.num_starts][: own.num_starts - half]
    u = np.concatenate([u[order[:half]], u[far]])
    scale = max(float(np.sqrt(np.mean(r[order[0]] ** 2))), 1.0)
    u, cost = along_secants(rival, u, unit * scale, own.first)
    best = u[np.argsort(cost)[: own.num_kept]]
    return min((polished(rival, p, unit, own) for p in best), key=lambda fit: fit.rms)


def polished(rival: Rival, u: Array, unit: Array, settings: FitSettings) -> LinearModel:
    """Return a model linearized at the best fit from a start near it.

    Args:
        rival: The model.
        u: The start, shape (d,).
        unit: Standard deviation of each number's error, shape (N,).
        settings: Settings of what is spent.
    """
    model = linearize(rival, u, unit, rival.step)
    for _ in range(settings.rounds - 1):
        scale = max(model.rms, 1.0)
        if model.promised < settings.worth * scale**2:
            break
        known = model.residual[None] / scale, model.jacobian[None] / scale
        start = np.clip(model.u, model.low, model.high)[None]
        new, _ = along_secants(rival, start, unit * scale, settings.secant, known)
        if (new[0] == model.u).all():
            break
        model = linearize(rival, new[0], unit, rival.step)
    return model


def along_secants(
    rival: Rival,
    u: Array,
    unit: Array,
    steps: int,
    known: tuple[Array, Array] | None = None,
) -> tuple[Array, Array]:
    """Return starts (n, d) improved along secants, and their cost.

    Args:
        rival: The model.
        u: Starts, shape (n, d).
        unit: Units of residuals, shape (N,).
        steps: Number of steps at most.
        known: Residuals in units and derivatives at the starts, (n, N) and (n, N, d).
    """
    return descend(
        *(rival, u, lambda r: r / unit, rival.step, steps), secant=True, known=known
    )

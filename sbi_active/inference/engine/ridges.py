"""Narrow proposals along what trials leave open.

A parameter that another can stand in for leaves a curved ridge, on which a normal
approximation at a mode has few of its draws, and a few components fitted to draws have
not many more.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sbi_active.inference.engine.potential import Potential
from sbi_active.inference.engine.search import Found
from sbi_active.inference.engine.settings import Settings
from sbi_active.inference.sampling.least_squares import descend, floored
from sbi_active.inference.sampling.student_mixture import (
    StudentMixture,
    lower_factors,
)
from sbi_active.inference.sampling.weights import log_sum_exp

Array = NDArray[Any]


def along_ridges(
    potential: Potential,
    found: Found,
    points: Array,
    rng: np.random.Generator,
    settings: Settings,
) -> StudentMixture | None:
    """Return narrow t distributions along the ridges; None if nothing is likely.

    Draws of the normal approximations, and points, are brought back to the ridge by
    steps that a prior around each damps, so that they move across it and not along.
    Each has the curvature of its place, and along the ridge the width that the points
    leave between them.

    Args:
        potential: Log density.
        found: Modes of it.
        points: Places that are known to be likely, shape (k, dim).
        rng: Source of the draws.
        settings: Number of places, and how far they may spread.
    """
    c, own = potential.coordinates, settings
    drawn = found.guess.sample(own.num_ridge, rng)
    u = np.concatenate([found.modes, points, drawn])
    u = np.clip(u, c.low, c.high)
    best, step = found.modes[:1], potential.step
    whiten = potential.whitener(best)
    u, _ = descend(
        potential, u, whiten, step, own.returning, center=u.copy(), secant=True
    )
    target = potential.log_prior(u) + potential.log_likelihood(u)
    if not np.isfinite(target.max()):
        return None
    u = u[target >= target.max() - 0.5 * own.search.negligible]
    precision = floored(potential)
    slopes = potential.jacobian(best, whiten, step)[1][0] / np.sqrt(precision)
    known = int((np.linalg.svd(slopes, compute_uv=False) > 1).sum())
    num_open = max(int(potential.searched.sum()) - known, 1)
    width = min(own.reach * own.num_ridge ** (-1 / num_open), 1.0)
    _, jac = potential.jacobian(u, whiten, step)
    local = np.einsum("nij,nik->njk", jac, jac) + np.diag(precision / width**2)
    factors = own.laplace_wider * lower_factors(np.linalg.inv(local))
    return StudentMixture(u, factors, np.full(len(u), 1 / len(u)))


def reweighted(mixture: StudentMixture, u: Array, weight: Array) -> StudentMixture:
    """Return a mixture with the weights that its components' draws deserve.

    Args:
        mixture: Components.
        u: Draws, shape (n, dim).
        weight: Weights of the draws, which sum to 1, shape (n,).
    """
    parts = mixture.log_parts(u)
    share = np.exp(parts - log_sum_exp(parts, axis=0))
    # Tempered weights: few draws must not shrink the next proposal to a point.
    flat = np.sqrt(weight)
    own = share @ (flat / flat.sum())
    return replace(mixture, weights=0.5 * own / own.sum() + 0.5 / len(own))

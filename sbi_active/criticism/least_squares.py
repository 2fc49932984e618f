"""Modes of a posterior by multi-start Levenberg-Marquardt."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sbi_active.criticism.errors import Whitener
from sbi_active.criticism.importance import INFLATION, TMixture
from sbi_active.criticism.rival import Rival

__all__ = ["Modes", "find_modes", "probe_step"]

Array = NDArray[Any]

NUM_STARTS = 16
#: Starts that go on after the first phase, iterations of the first and of each later
#: phase, and later phases at least and at most.
NUM_KEPT, EARLY, LATE, PHASES = 8, 4, 3, (2, 8)
#: Sum of squares that a phase must take off the best start to be worth another.
PROGRESS = 0.5
MAX_MODES = 8
#: Modes whose sum of squares exceeds the best by this hold no mass that counts.
NEGLIGIBLE = 40.0
#: Finite-difference steps in prior deviations, and where two of them count as one.
STEPS, SAME_SLOPE = (1e-4, 1e-3, 1e-2, 5e-2), 0.1


@dataclass(frozen=True)
class Modes:
    """Modes of a posterior.

    Attributes:
        u: Best first, shape (k, dim).
        proposal: t distributions at the modes.
    """

    u: Array
    proposal: TMixture


def probe_step(rival: Rival, *, seed: int) -> tuple[float, bool]:
    """Return a step for finite differences, and whether the simulator is smooth.

    The step is the smallest whose slope agrees with that of twice the step within 10 %
    for most of four draws from the prior: below it rounding or a solver's tolerance
    speaks, and where there is none the simulator jumps.

    Args:
        rival: The bare model.
        seed: Of the draws.
    """
    u = rival.coordinates.sample(4, seed=seed)
    whiten = rival.error.start()
    for step in STEPS:
        _, one = rival.jacobian(u, whiten, step)
        _, two = rival.jacobian(u, whiten, 2 * step)
        size = np.sqrt((one**2).sum((1, 2))) + 1e-12
        gap = np.sqrt(((one - two) ** 2).sum((1, 2))) / size
        if np.median(gap) < SAME_SLOPE:
            return step, True
    return STEPS[-1], False


def find_modes(
    rival: Rival, *, step: float, seed: int, near: Array | None = None
) -> Modes:
    r"""Return modes of the posterior and t distributions around them.

    Minimizes :math:`\|W r(u)\|^2 + \|u - a\|_P^2` with the whitening W that the
    residual at the best point makes most probable, updated on the way.

    Args:
        rival: The model.
        step: Of finite differences, in u.
        seed: Of the starts.
        near: Points to start some of the searches from, shape (k, dim).

    References:
        Marquardt, SIAM Journal on Applied Mathematics 11 (1963).
    """
    u = rival.coordinates.sample(NUM_STARTS, seed=seed)
    if near is not None:
        some = min(len(near), NUM_STARTS // 2)
        u[:some] = near[:some]
    fixed = ~rival.searched
    u[:, fixed] = 0.0
    u = np.clip(u, rival.coordinates.low, rival.coordinates.high)
    whiten = rival.error.start()
    u, cost = _descend(rival, u, whiten, step, EARLY)
    u = u[np.argsort(cost)[:NUM_KEPT]]
    best = np.inf
    for phase in range(PHASES[1]):
        whiten = rival.error.whitener(rival.residual(u[:1])[0][0])
        u, cost = _descend(rival, u, whiten, step, LATE)
        u, cost = u[np.argsort(cost)], np.sort(cost)
        if phase + 1 >= PHASES[0] and best - cost[0] < PROGRESS:
            break
        best = cost[0]
    modes = [u[0]]
    for candidate, c in zip(u[1:], cost[1:], strict=True):
        apart = all(np.abs(candidate - mode).max() > 0.02 for mode in modes)
        if c - cost[0] < NEGLIGIBLE and apart and len(modes) < MAX_MODES:
            modes.append(candidate)
    at = np.stack(modes)
    _, jac = rival.jacobian(at, whiten, step)
    precision = np.einsum("nij,nik->njk", jac, jac)
    # Never wider than the prior: a flat direction has its variance.
    precision = precision + np.diag(np.maximum(rival.coordinates.precision, 0.3))
    precision[:, fixed] = 0.0
    precision[:, :, fixed] = 0.0
    precision = precision + np.diag(fixed.astype(float))
    factors = np.linalg.cholesky(np.linalg.inv(precision) * INFLATION)
    return Modes(at, TMixture(at, factors))


def _descend(
    rival: Rival, u: Array, whiten: Whitener, step: float, iterations: int
) -> tuple[Array, Array]:
    """Return improved starts and their cost, shapes (n, dim) and (n,)."""
    c, dim = rival.coordinates, rival.dim
    free = rival.searched
    damping = np.full(len(u), 1e-2)

    def penalized(r: Array, u: Array) -> Array:
        return (r**2).sum(1) + ((u - c.center) ** 2 * c.precision).sum(1)

    r, jac = rival.jacobian(u, whiten, step)
    cost = penalized(r, u)
    for i in range(iterations):
        normal = np.einsum("nij,nik->njk", jac, jac) + np.diag(c.precision)
        gradient = np.einsum("nij,ni->nj", jac, r) + (u - c.center) * c.precision
        diagonal = np.einsum("njj->nj", normal)
        lift = damping[:, None] * diagonal + 1e-8
        system = normal + lift[:, :, None] * np.eye(dim)
        move = np.linalg.solve(system, gradient[..., None])[..., 0]
        new = np.clip(u - np.where(free, move, 0.0), c.low, c.high)
        last = i == iterations - 1
        if last:
            new_r, new_jac = whiten(rival.residual(new)[0]), jac
        else:
            new_r, new_jac = rival.jacobian(new, whiten, step)
        new_cost = penalized(new_r, new)
        better = new_cost < cost
        u, cost = np.where(better[:, None], new, u), np.where(better, new_cost, cost)
        r = np.where(better[:, None], new_r, r)
        jac = np.where(better[:, None, None], new_jac, jac)
        damping = np.where(better, damping * 0.15, damping * 6)
    return u, cost

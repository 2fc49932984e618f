"""Modes of a posterior by multi-start Levenberg-Marquardt."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sbi_active.criticism.errors import Whitener
from sbi_active.criticism.importance import INFLATION, TMixture
from sbi_active.criticism.rival import Rival
from sbi_active.seeding import derive_seed

__all__ = ["Modes", "along_ridges", "find_modes", "probe_step"]

Array = NDArray[Any]

NUM_STARTS = 16
#: Draws of the prior of which the best are among the starts.
NUM_SCREENED, NUM_BEST = 200, 4
#: Sum of squares a number beyond which a point is far from a fit.
FAR = 5.0
#: Points along what the data leave open, which spans this many deviations of the prior.
NUM_POINTS, RANGE = 64, 4.0
#: Precision that stands for a uniform prior where a proposal must have some.
FLAT = 0.3
#: Iterations that bring a point back to where the data put it.
RETURN = 5
#: Starts that go on after the first phase, iterations of the first and of each later
#: phase, and later phases at least and at most.
NUM_KEPT, EARLY, LATE, PHASES = 8, 4, 4, (2, 10)
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
        whiten: That the residual at the best mode makes most probable.
    """

    u: Array
    proposal: TMixture
    whiten: Whitener


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
    whiten = rival.error.start()
    screened = rival.coordinates.sample(NUM_SCREENED, seed=derive_seed(seed, "screen"))
    squares = (whiten(rival.residual(screened)[0]) ** 2).sum(1)
    u[-NUM_BEST:] = screened[np.argsort(squares)[:NUM_BEST]]
    u[:, fixed] = 0.0
    u = np.clip(u, rival.coordinates.low, rival.coordinates.high)
    u, cost = _descend(rival, u, whiten, step, EARLY)
    u = u[np.argsort(cost)[:NUM_KEPT]]
    best, stalls = np.inf, 0
    for phase in range(PHASES[1]):
        whiten = rival.error.whitener(rival.residual(u[:1])[0][0])
        u, cost = _descend(rival, u, whiten, step, LATE)
        u, cost = u[np.argsort(cost)], np.sort(cost)
        stalls = stalls + 1 if best - cost[0] < PROGRESS else 0
        # Far from a fit, a phase may be lost to finding the damping.
        patience = 3 if cost[0] > FAR * len(rival.simulator.measurements) else 1
        if phase + 1 >= PHASES[0] and stalls >= patience:
            break
        best = cost[0]
    modes = [u[0]]
    for candidate, c in zip(u[1:], cost[1:], strict=True):
        apart = all(np.abs(candidate - mode).max() > 0.02 for mode in modes)
        if c - cost[0] < NEGLIGIBLE and apart and len(modes) < MAX_MODES:
            modes.append(candidate)
    at = np.stack(modes)
    # Never wider than the prior: a flat direction has its variance.
    means, factors = [at], [_factors(rival, at, whiten, step, 1.0)]
    for other in rival.error.regimes():
        own, _ = _descend(rival, at[:1], other, step, LATE)
        means.append(own)
        factors.append(_factors(rival, own, other, step, 1.0))
    proposal = TMixture(np.concatenate(means), np.concatenate(factors))
    return Modes(at, proposal, whiten)


def along_ridges(
    rival: Rival, modes: Modes, *, step: float, rng: np.random.Generator
) -> TMixture:
    """Return narrow t distributions along what the data leave open.

    A parameter that an effect can imitate leaves a curved ridge, on which a t
    distribution at a mode has few of its draws. Draws of it are brought back to the
    ridge by steps that the prior damps, so that they move across it and not along; each
    has the curvature of its place, and along the ridge the width that the points leave
    between them.

    Args:
        rival: The model.
        modes: Its modes.
        step: Of finite differences, in u.
        rng: Source of the points.
    """
    c = rival.coordinates
    u = np.concatenate([modes.u, modes.proposal.sample(NUM_POINTS, rng)])
    u = np.clip(u, c.low, c.high)
    u, _ = _descend(rival, u, modes.whiten, step, RETURN, center=u.copy())
    target = rival.log_prior(u) + rival.log_likelihood(u)
    if not np.isfinite(target.max()):
        return modes.proposal
    u = u[target > target.max() - NEGLIGIBLE / 2]
    _, jac = rival.jacobian(modes.u[:1], modes.whiten, step)
    known = np.linalg.svd(jac[0] / np.sqrt(_floor(rival)), compute_uv=False) > 1
    num_open = max(int(rival.searched.sum() - known.sum()), 1)
    width = min(RANGE * NUM_POINTS ** (-1 / num_open), 1.0)
    return TMixture(u, _factors(rival, u, modes.whiten, step, width))


def _floor(rival: Rival) -> Array:
    """Return the prior's precision, shape (dim,), a wide one between two bounds."""
    return np.maximum(rival.coordinates.precision, FLAT)


def _factors(
    rival: Rival, u: Array, whiten: Whitener, step: float, width: float
) -> Array:
    """Return Cholesky factors of the local covariances, within a width."""
    _, jac = rival.jacobian(u, whiten, step)
    precision = np.einsum("nij,nik->njk", jac, jac)
    precision = precision + np.diag(_floor(rival) / width**2)
    fixed = ~rival.searched
    precision[:, fixed] = 0.0
    precision[:, :, fixed] = 0.0
    precision = precision + np.diag(fixed.astype(float))
    return np.linalg.cholesky(np.linalg.inv(precision) * INFLATION)


def _descend(
    rival: Rival,
    u: Array,
    whiten: Whitener,
    step: float,
    iterations: int,
    center: Array | None = None,
) -> tuple[Array, Array]:
    """Return improved starts and their cost, shapes (n, dim) and (n,).

    Without a center, shape (n, dim), the penalty is that of the prior.
    """
    c, dim = rival.coordinates, rival.dim
    weight = c.precision if center is None else _floor(rival)
    center = c.center if center is None else center
    free = rival.searched
    damping = np.full(len(u), 1e-2)

    def penalized(r: Array, u: Array) -> Array:
        return (r**2).sum(1) + ((u - center) ** 2 * weight).sum(1)

    r, jac = rival.jacobian(u, whiten, step)
    cost = penalized(r, u)
    for i in range(iterations):
        normal = np.einsum("nij,nik->njk", jac, jac) + np.diag(weight)
        gradient = np.einsum("nij,ni->nj", jac, r) + (u - center) * weight
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
        damping = np.where(better, damping * 0.15, damping * 10)
    return u, cost

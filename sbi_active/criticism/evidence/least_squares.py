"""Modes of a posterior by multi-start Levenberg-Marquardt."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sbi_active.criticism.evidence.importance import INFLATION, lower_factors
from sbi_active.criticism.rivals.error_models import Whitener
from sbi_active.criticism.rivals.rival import Rival
from sbi_active.inference.sampling.student_mixture import StudentMixture
from sbi_active.seeding import derive_seed

Array = NDArray[Any]

#: Times that coordinates are held at their bounds, or let go, in a step.
HELD = 20
#: Sum of squares a number beyond which a point is far from a fit.
FAR = 5.0
#: Points along what the data leave open, which spans this many deviations of the prior.
NUM_POINTS, RANGE = 64, 4.0
#: Precision that stands for a uniform prior where a proposal must have some.
FLAT = 0.3
#: Iterations that bring a point back to where the data put it.
RETURN = 5
#: Iterations of the first phase in two halves and of each later phase.
EARLY, LATE = (3, 3), 4
#: Coordinates within which two points count as the same, early and late.
NEAR_MODE, SAME_MODE = 0.05, 0.02
#: Expected fall of a sum of squares that is worth no further iteration.
CONVERGED = 0.02
#: Sum of squares that a phase must take off the best start to be worth another.
PROGRESS = 0.5
MAX_MODES = 8
#: Modes whose sum of squares exceeds the best by this hold no mass that counts.
NEGLIGIBLE = 40.0


@dataclass(frozen=True, kw_only=True)
class Search:
    """How much a search for modes does.

    Attributes:
        num_starts: In all.
        num_near: Of these, points near smaller rivals' posteriors, at most.
        num_best: Of these, the best of the screened draws.
        num_screened: Draws of the prior that are screened.
        num_kept: Starts that go on after either half of the first phase.
        phases: Later ones, at least and at most.
        widened: Factor on the covariances at the modes.
    """

    num_starts: int
    num_near: int
    num_best: int
    num_screened: int
    num_kept: tuple[int, int]
    phases: tuple[int, int]
    widened: float = 1.0


#: Choices, here and below: from draws of the prior alone.
THOROUGH = Search(
    num_starts=20,
    num_near=6,
    num_best=6,
    num_screened=128,
    num_kept=(10, 6),
    phases=(2, 10),
)
#: With fits of smaller models to start from.
NESTED = Search(
    num_starts=10,
    num_near=6,
    num_best=2,
    num_screened=32,
    num_kept=(6, 4),
    phases=(2, 10),
)
#: Where the simulator jumps, derivatives lead to the neighborhood of a mode at most,
#: and the mode is wider than they say.
ROUGH = Search(
    num_starts=10,
    num_near=4,
    num_best=4,
    num_screened=128,
    num_kept=(5, 3),
    phases=(1, 2),
    widened=4.0,
)


@dataclass(frozen=True)
class Modes:
    """Modes of a posterior.

    Attributes:
        u: Best first, shape (k, dim).
        proposal: t distributions at the modes.
        whiten: That the residual at the best mode makes most probable.
    """

    u: Array
    proposal: StudentMixture
    whiten: Whitener


def find_modes(
    rival: Rival,
    *,
    step: float,
    seed: int,
    near: Array | None = None,
    search: Search = THOROUGH,
) -> Modes:
    r"""Return modes of the posterior and t distributions around them.

    Minimizes :math:`\|W r(u)\|^2 + \|u - a\|_P^2` with the whitening W that the
    residual at the best point makes most probable, updated on the way.

    Args:
        rival: The model.
        step: Of finite differences, in u.
        seed: Of the starts.
        near: Points to start some of the searches from, shape (k, dim).
        search: How much it does.

    References:
        Marquardt, SIAM Journal on Applied Mathematics 11 (1963); Broyden, Mathematics
        of Computation 19 (1965), for the derivatives of the first phase.
    """
    u = rival.coordinates.sample(search.num_starts, seed=seed)
    if near is not None:
        some = min(len(near), search.num_near)
        u[:some] = near[:some]
    fixed = ~rival.searched
    whiten = rival.error.start()
    screened = rival.coordinates.sample(
        search.num_screened, seed=derive_seed(seed, "screen")
    )
    squares = (whiten(rival.residual(screened)[0]) ** 2).sum(1)
    u[-search.num_best :] = screened[np.argsort(squares)[: search.num_best]]
    u[:, fixed] = 0.0
    u = np.clip(u, rival.coordinates.low, rival.coordinates.high)
    for iterations, most in zip(EARLY, search.num_kept, strict=True):
        u, cost = descend(rival, u, whiten, step, iterations, secant=True)
        u = _distinct(u[np.argsort(cost)], NEAR_MODE)[:most]
    best, stalls = np.inf, 0
    for phase in range(search.phases[1]):
        whiten = rival.error.whitener(rival.residual(u[:1])[0][0])
        u, cost = descend(rival, u, whiten, step, LATE)
        order = np.argsort(cost)
        order = order[_which_distinct(u[order], SAME_MODE / 4)]
        u, cost = u[order], cost[order]
        stalls = stalls + 1 if best - cost[0] < PROGRESS else 0
        # Far from a fit, a phase may be lost to finding the damping.
        patience = 3 if cost[0] > FAR * len(rival.simulator.measurements) else 1
        if phase + 1 >= search.phases[0] and stalls >= patience:
            break
        best = cost[0]
    at = _distinct(u[cost - cost[0] < NEGLIGIBLE], SAME_MODE)[:MAX_MODES]
    # Never wider than the prior: a flat direction has its variance.
    means, factors = [at], [_factors(rival, at, whiten, step, 1.0)]
    for other in rival.error.regimes(rival.residual(at[:1])[0][0]):
        own, _ = descend(rival, at[:1], other, step, LATE, secant=True)
        means.append(own)
        factors.append(_factors(rival, own, other, step, 1.0))
    wide = np.concatenate(factors) * np.sqrt(search.widened)
    proposal = StudentMixture(np.concatenate(means), wide)
    return Modes(at, proposal, whiten)


def along_ridges(
    rival: Rival,
    modes: Modes,
    *,
    step: float,
    rng: np.random.Generator,
    points: Array | None = None,
) -> StudentMixture:
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
        points: That are known to lie on the ridge, shape (k, dim).
    """
    c = rival.coordinates
    on = modes.u if points is None else np.concatenate([modes.u, points])
    u = np.concatenate([on, modes.proposal.sample(NUM_POINTS, rng)])
    u = np.clip(u, c.low, c.high)
    u, _ = descend(rival, u, modes.whiten, step, RETURN, center=u.copy(), secant=True)
    target = rival.log_prior(u) + rival.log_likelihood(u)
    if not np.isfinite(target.max()):
        return modes.proposal
    u = u[target >= target.max() - NEGLIGIBLE / 2]
    _, jac = rival.jacobian(modes.u[:1], modes.whiten, step)
    known = np.linalg.svd(jac[0] / np.sqrt(_floor(rival)), compute_uv=False) > 1
    num_open = max(int(rival.searched.sum() - known.sum()), 1)
    width = min(RANGE * NUM_POINTS ** (-1 / num_open), 1.0)
    return StudentMixture(u, _factors(rival, u, modes.whiten, step, width))


def local_proposal(
    rival: Rival, u: Array, whiten: Whitener, step: float
) -> StudentMixture:
    """Return t distributions at points, shape (k, dim), as narrow as the data say."""
    return StudentMixture(u, _factors(rival, u, whiten, step, 1.0))


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
    return lower_factors(np.linalg.inv(precision) * INFLATION)


def _which_distinct(u: Array, apart: float) -> list[int]:
    """Return the places of points that lie apart from all those before them."""
    kept: list[int] = []
    for i, point in enumerate(u):
        if all(np.abs(point - u[j]).max() > apart for j in kept):
            kept.append(i)
    return kept


def _distinct(u: Array, apart: float) -> Array:
    return u[_which_distinct(u, apart)]


def descend(
    rival: Rival,
    u: Array,
    whiten: Whitener,
    step: float,
    iterations: int,
    *,
    center: Array | None = None,
    secant: bool = False,
    known: tuple[Array, Array] | None = None,
) -> tuple[Array, Array]:
    """Return improved starts and their cost, shapes (n, dim) and (n,).

    Args:
        rival: The model.
        u: Starts, shape (n, dim).
        whiten: Of the residuals.
        step: Of finite differences.
        iterations: At most; a start that is expected to gain nothing stops.
        center: Of the penalty, shape (n, dim); None has that of the prior.
        secant: Derivatives are updated from the steps made, by Broyden's rule, and not
            computed again.
        known: Whitened residuals at the starts and their derivatives, shapes (n, N) and
            (n, N, dim), where they need no simulation.
    """
    c, dim = rival.coordinates, rival.dim
    weight = c.precision if center is None else _floor(rival)
    center = np.broadcast_to(c.center if center is None else center, u.shape)
    free = rival.searched
    damping = np.full(len(u), 1e-2)
    u = u.copy()

    def penalized(r: Array, at: Array, rows: Array) -> Array:
        return (r**2).sum(1) + ((at - center[rows]) ** 2 * weight).sum(1)

    if known is None:
        known = rival.jacobian(u, whiten, step)
    r, jac = (part.copy() for part in known)
    cost = penalized(r, u, np.arange(len(u)))
    rows = np.arange(len(u))
    for i in range(iterations):
        part = jac[rows]
        normal = np.einsum("nij,nik->njk", part, part) + np.diag(weight)
        gradient = np.einsum("nij,ni->nj", part, r[rows])
        gradient = gradient + (u[rows] - center[rows]) * weight
        diagonal = np.einsum("njj->nj", normal)
        lift = damping[rows, None] * diagonal + 1e-8
        system = normal + lift[:, :, None] * np.eye(dim)
        move = within(system, gradient, u[rows], c.low, c.high)
        new = np.clip(u[rows] - np.where(free, move, 0.0), c.low, c.high)
        linear = np.einsum("nij,nj->ni", part, new - u[rows])
        expected = cost[rows] - penalized(r[rows] + linear, new, rows)
        worth = expected > CONVERGED
        rows, new, linear = rows[worth], new[worth], linear[worth]
        if not len(rows):
            break
        new_r = whiten(rival.residual(new)[0])
        new_cost = penalized(new_r, new, rows)
        if secant:
            change = new - u[rows]
            miss = new_r - r[rows] - linear
            length = np.maximum((change**2).sum(1), 1e-300)[:, None, None]
            jac[rows] += miss[:, :, None] * change[:, None] / length
        better = new_cost < cost[rows]
        won = rows[better]
        u[won], cost[won], r[won] = new[better], new_cost[better], new_r[better]
        if len(won) and not secant and i < iterations - 1:
            _, jac[won] = rival.jacobian(u[won], whiten, step)
        damping[rows] = damping[rows] * np.where(better, 0.15, 10.0)
    return u, cost


def within(system: Array, gradient: Array, u: Array, low: Array, high: Array) -> Array:
    """Return the steps of normal equations, (n, dim), along the bounds they stand at.

    A coordinate that a step would take beyond its bound is held, and the others are
    found again: clipped alone, it would leave them where they are right only with it.

    Args:
        system: Shape (n, dim, dim).
        gradient: Shape (n, dim).
        u: Shape (n, dim).
        low: Lower bounds, shape (dim,).
        high: Upper bounds.

    References:
        Bertsekas, SIAM Journal on Control and Optimization 20 (1982).
    """
    move = np.linalg.solve(system, gradient[..., None])[..., 0]
    # Of a coordinate at its upper bound, signs turn around.
    side = (u <= low).astype(float) - (u >= high)
    for i in np.flatnonzero((side * move > 0).any(1)):
        held = np.zeros(u.shape[1], dtype=bool)
        for _ in range(HELD):
            out = ~held & (side[i] * move[i] > 0)
            # What is held, and would now be better off inside.
            pull = side[i] * (gradient[i] - system[i] @ move[i])
            back = held & (pull < 0) & (not out.any())
            if not out.any() and not back.any():
                break
            if back.any():
                back &= pull == pull[back].min()
            held = (held | out) & ~back
            move[i] = 0.0
            open_ = np.ix_(~held, ~held)
            move[i, ~held] = np.linalg.solve(system[i][open_], gradient[i, ~held])
    return move

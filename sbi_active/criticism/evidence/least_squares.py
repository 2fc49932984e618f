"""Modes of a posterior by multi-start Levenberg-Marquardt."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sbi_active.criticism.evidence.importance import INFLATION, lower_factors
from sbi_active.criticism.rivals.error_models import Whitener
from sbi_active.criticism.rivals.rival import Rival
from sbi_active.inference.sampling.least_squares import descend, floored
from sbi_active.inference.sampling.student_mixture import StudentMixture
from sbi_active.seeding import derive_seed

Array = NDArray[Any]

#: Sum of squares a number beyond which a point is far from a fit.
FAR = 5.0
#: Points along what the data leave open, which spans this many deviations of the prior.
NUM_POINTS, RANGE = 32, 4.0
#: Iterations that bring a point back to where the data put it.
RETURN = 5
#: Iterations of the first phase in two halves and of each later phase.
EARLY, LATE = (3, 3), 4
#: Coordinates within which two points count as the same, early and late.
NEAR_MODE, SAME_MODE = 0.05, 0.02
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
    known = np.linalg.svd(jac[0] / np.sqrt(floored(rival)), compute_uv=False) > 1
    num_open = max(int(rival.searched.sum() - known.sum()), 1)
    width = min(RANGE * NUM_POINTS ** (-1 / num_open), 1.0)
    return StudentMixture(u, _factors(rival, u, modes.whiten, step, width))


def local_proposal(
    rival: Rival, u: Array, whiten: Whitener, step: float
) -> StudentMixture:
    """Return t distributions at points, shape (k, dim), as narrow as the data say."""
    return StudentMixture(u, _factors(rival, u, whiten, step, 1.0))


def _factors(
    rival: Rival, u: Array, whiten: Whitener, step: float, width: float
) -> Array:
    """Return Cholesky factors of the local covariances, within a width."""
    _, jac = rival.jacobian(u, whiten, step)
    precision = np.einsum("nij,nik->njk", jac, jac)
    precision = precision + np.diag(floored(rival) / width**2)
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

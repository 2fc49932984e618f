r"""Modes of a potential and their widths, by Gauss-Newton steps from many starts.

.. math::
    \tfrac12 \sum_k \bigl\| C_k^{-1/2} (x_k - f(\theta, \xi_k)) \bigr\|^2
    + \tfrac12 \| u \|^2,

A derivative costs a simulation a parameter; no cost grows faster with their number.
Where the error has unknowns, C is what the best place so far makes most probable.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist
from scipy.stats import chi2

from sbi_active.arrays import Array
from sbi_active.inference.engine.potential import Potential
from sbi_active.inference.sampling.least_squares import Whitener, descend, floored
from sbi_active.inference.sampling.mixtures import StudentMixture, lower_factors


@dataclass(frozen=True, kw_only=True)
class SearchSettings:
    """Settings of a search.

    Attributes:
        num_screened: Draws of the prior of which the best begin the first searches;
            twice as many the next; with none, one search begins at each place near. Of
            oscillations a quarter of the searches that begin at the best of 192 end at
            the truth; fewer begin further off.
        num_starts: Searches at a time. Half misses one of eight modes twice as often.
        share_odd: Share of these that begin where outcomes are odd, and at most as many
            at draws that are better than all around them; the rest at the best. Of
            modes a thirtieth of the prior wide in two parameters beside a wide one,
            searches meet 52 % without, 98 % with it, and with half and twice 93 % and
            all. With twice, ridges are followed less far.
        num_around: Number of draws around, in numbers of what is fitted to these, d +
            1. Two and four meet as many.
        max_starts: Searches at most.
        num_found: Times that the best mode is to be found, or there are more searches:
            once may be chance.
        explained: Tail probability of the best mode's residuals, below which there are
            more searches: of motions that oscillate, many end in the same wrong place.
        iterations: Steps of a search.
        same: Fall of the cost, in nats times 2, within which two searches found the
            same mode.
        negligible: Rise of the cost beyond which a mode holds no mass.
        phases: Times at most that the best searches go on, of an unknown error with
            what the best place makes most probable.
        num_kept: Searches that go on.
        later: Steps of each.
        progress: Fall of the cost that is worth another phase.
        wider: Factor of the widths of the Laplace approximation (a choice).
        faint: Derivative, which rounding may give, below which a coordinate moves no
            trial.
    """

    num_screened: int = 192
    num_starts: int = 18
    share_odd: float = 0.25
    num_around: int = 3
    max_starts: int = 64
    num_found: int = 3
    explained: float = 1e-4
    iterations: int = 30
    same: float = 2.0
    negligible: float = 40.0
    phases: int = 0
    num_kept: int = 4
    later: int = 10
    progress: float = 0.5
    faint: float = 0.1
    wider: float = 1.1


@dataclass(frozen=True)
class Found:
    """The result of a search.

    Attributes:
        guess: A normal component a mode, weighted by its mass; behind these, one an
            error that leaves other widths.
        modes: Best first, shape (k, d).
        informed: Coordinates that move some trial at a mode or draw, shape (d,).
        num_found: Searches that ended at the best mode.
        num_starts: Searches in all.
        screened: Draws of the prior that were looked at, shape (n, d).
        wider: Factor of the components' widths, which a Laplace approximation has not.
    """

    guess: StudentMixture
    modes: Array
    informed: NDArray[np.bool_]
    num_found: int
    num_starts: int
    screened: Array
    wider: float


def search(
    problem: Potential,
    rng: np.random.Generator,
    near: Array | None = None,
    settings: SearchSettings = SearchSettings(),  # noqa: B008  (frozen)
    *,
    screened: Array | None = None,
    believed: Array | None = None,
) -> Found | None:
    r"""Return normal approximations at the modes; None if no search gets anywhere.

    Searches begin at the best of some draws of the prior and at points near, and again
    at the best of more draws until the best mode was found several times and explains
    the outcomes, and until the number of modes, of which n searches found w, is not
    expected to exceed w,

    .. math::
        \frac{w (n - 1)}{n - w - 2} < w + \tfrac12 .

    Args:
        problem: The sum of squares that is searched.
        rng: Source of the draws.
        near: Places to begin at as well, shape (k, d).
        settings: Numbers of searches.
        screened: Draws of the prior to look at first, shape (n, d); None draws them.
        believed: Draws of an earlier belief, shape (m, d), the best of which begin
            searches where the first do not suffice: where the response jumps, a single
            draw may begin on the wrong side.

    References:
        Boender & Rinnooy Kan, Mathematical Programming 37 (1987).
    """
    own, c, dim = settings, problem.coordinates, problem.dim
    whiten, looked, num, u = problem.whitener(), [], 0, np.empty((0, dim))

    def start_at(places: Array) -> Array:
        return np.clip(np.where(problem.searched, places, c.center), c.low, c.high)

    while True:
        drawn = screened
        if drawn is None or looked:
            drawn = problem.sample_prior(own.num_screened * 2 ** len(looked), rng)
        looked.append(drawn)
        starts = start_at(drawn)
        if len(starts):
            starts = starts[_promising(problem, starts, whiten, own)]
        if near is not None and num == 0:
            starts = np.concatenate([start_at(near), starts])
        if believed is not None and len(looked) == 2:
            likely = start_at(believed)
            best = np.argsort(_cost(problem, likely, whiten)[0])[: own.num_kept]
            starts = np.concatenate([likely[best], starts])
        num += len(starts)
        ends, _ = descend(problem, starts, whiten, problem.step, own.iterations)
        u = np.concatenate([u, ends])
        u, cost, whiten = _settled(problem, u, whiten, own)
        if not np.isfinite(cost.min()):
            return None
        modes, counts, precision, jac = _apart(problem, u, cost, whiten, own)
        ended = sum(counts)
        expected = len(modes) * (ended - 1) / max(ended - len(modes) - 2, 1e-9)
        square = float((whiten(problem.residual(u[modes[:1]])[0]) ** 2).sum())
        is_found = chi2.sf(square, problem.num_observed) >= own.explained
        is_found &= (cost - cost.min() < own.same).sum() >= own.num_found
        is_found &= ended > len(modes) + 2 and expected < len(modes) + 0.5
        if is_found or num >= own.max_starts or not own.num_screened:
            break
    log_mass = -0.5 * cost[modes] - 0.5 * np.linalg.slogdet(precision[modes])[1]
    mass = np.exp(log_mass - log_mass.max())
    # A mode that is worth little is still visited.
    mass = 0.9 * mass / mass.sum() + 0.1 / len(mass)
    factors = own.wider * lower_factors(np.linalg.inv(precision[modes]))
    return Found(
        StudentMixture(u[modes], factors, mass, np.inf),
        u[modes],
        np.abs(jac).max((0, 1)) > own.faint,
        int((cost - cost.min() < own.same).sum()),
        num,
        np.concatenate(looked),
        own.wider,
    )


def laplace_precision(
    problem: Potential, u: Array, whiten: Whitener
) -> tuple[Array, Array]:
    """Return precisions (n, d, d) of normal approximations, and derivatives (n, N, d).

    Args:
        problem: The sum of squares.
        u: Places, shape (n, d).
        whiten: Whitener of the residuals.
    """
    _, jac = problem.jacobian(u, whiten, problem.step)
    # Never wider than the prior: a flat direction has its variance.
    return np.einsum("nij,nik->njk", jac, jac) + np.diag(floored(problem)), jac


def _cost(problem: Potential, u: Array, whiten: Whitener) -> tuple[Array, Array]:
    """Return sums of squares with that of the prior, (n,), and residuals, (n, N)."""
    c, residual = problem.coordinates, whiten(problem.residual(u)[0])
    prior = ((u - c.center) ** 2 * c.precision).sum(1)
    return (residual**2).sum(1) + prior, residual


def _promising(
    problem: Potential, u: Array, whiten: Whitener, settings: SearchSettings
) -> list[int]:
    """Return the rows of places to begin at.

    The best are in one wide mode where there is one, beside which a narrow mode has a
    draw or two that need not be good. Such a draw is better than those around it, or
    its outcomes are not what they predict.

    References:
        Rinnooy Kan & Timmer, Mathematical Programming 39 (1987).
    """
    own, (cost, residual) = settings, _cost(problem, u, whiten)
    best, num = np.argsort(cost), own.num_starts
    num_odd, num_around = int(own.share_odd * num), own.num_around * (problem.dim + 1)
    if num_around >= len(u):
        return best[:num].tolist()
    apart = cdist(u, u)
    np.fill_diagonal(apart, np.inf)
    around = np.argpartition(apart, num_around, axis=1)[:, :num_around]
    better = (cost < cost[around].min(1))[best]
    odd = oddity(u, residual, around)
    rows = [*dict.fromkeys([*best[better][:num_odd], *best])][: num - num_odd]
    return [*dict.fromkeys([*rows, *np.argsort(-odd)])][:num]


def oddity(
    u: Array, residual: Array, around: NDArray[np.int64], *, most: int = 4_000_000
) -> Array:
    r"""Return how far residuals are from what those around predict, shape (n,).

    A plane through k residuals around a place leaves a mean square s of them, and
    predicts one at the place with a variance h s, so that

    .. math::
        \frac{\| r - \hat r \|^2}{(1 + h) (1 + s)}

    is large at a jump or in a narrow feature, and not where a response is steep. The 1
    beside s is the noise, below which nothing is odd.

    Args:
        u: Places, shape (n, d).
        residual: Whitened residuals, shape (n, N).
        around: Rows of the places around each, shape (n, k), of more than d + 1.
        most: Number of products of residuals at once, 32 MB.
    """
    n, k, d = *around.shape, u.shape[1]
    # Products of residuals suffice, however many numbers these have.
    off = residual - residual[0]
    product, parts = off @ off.T, []
    for rows in np.array_split(np.arange(n), 1 + n * k**2 // most):
        own = around[rows]
        x = np.concatenate([np.ones((len(rows), k, 1)), u[own] - u[rows, None]], 2)
        across = np.swapaxes(x, 1, 2)
        plane = np.linalg.solve(across @ x + 1e-9 * np.eye(d + 1), across)
        weight = plane[:, :1]
        near = product[own[:, :, None], own[:, None]]
        miss = weight @ (near @ np.swapaxes(weight, 1, 2))
        miss = miss[:, 0, 0] + product[rows, rows]
        miss -= 2 * (weight[:, 0] * product[rows[:, None], own]).sum(1)
        left = np.trace(near, axis1=1, axis2=2) - (across * (plane @ near)).sum((1, 2))
        left = np.maximum(left, 0.0) / (k - d - 1)
        parts.append(miss / (1 + (weight**2).sum((1, 2))) / (1 + left))
    return np.concatenate(parts)


def _settled(
    problem: Potential,
    u: Array,
    whiten: Whitener,
    settings: SearchSettings,
    *,
    far: float = 5.0,
) -> tuple[Array, Array, Whitener]:
    """Return places, their cost, and the error that the best makes most probable.

    A place is far from a fit if its mean square exceeds ``far``.
    """
    own, u, cost, stalls = settings, u.copy(), _cost(problem, u, whiten)[0], 0
    for _ in range(own.phases):
        whiten = problem.whitener(u[[cost.argmin()]])
        cost, _ = _cost(problem, u, whiten)  # where all is simulated already
        before, rows = cost.min(), _distinct(u, cost)[: own.num_kept]
        u[rows], cost[rows] = descend(problem, u[rows], whiten, problem.step, own.later)
        stalls = stalls + 1 if before - cost.min() < own.progress else 0
        # Far from a fit, a phase may be lost to finding the damping.
        patience = 3 if cost.min() > far * problem.num_observed else 1
        if stalls >= patience:
            break
    return u, cost, whiten


def _distinct(u: Array, cost: Array, *, distinct: float = 0.005) -> list[int]:
    """Return the rows of places that differ from all better ones, best first."""
    kept: list[int] = []
    for i in np.argsort(cost):
        if all(np.abs(u[i] - u[j]).max() > distinct for j in kept):
            kept.append(int(i))
    return kept


def _apart(
    problem: Potential,
    u: Array,
    cost: Array,
    whiten: Whitener,
    settings: SearchSettings,
) -> tuple[list[int], list[int], Array, Array]:
    """Return modes apart from one another, searches at each, precisions, slopes."""
    precision, jac = laplace_precision(problem, u, whiten)
    modes, counts = [], []
    for i in np.argsort(cost):
        if cost[i] - cost.min() >= settings.negligible:
            break
        for place, j in enumerate(modes):
            off = u[i] - u[j]
            if off @ precision[j] @ off < problem.dim + 10:
                counts[place] += 1
                break
        else:
            modes.append(int(i))
            counts.append(1)
    return modes, counts, precision, jac

r"""Modes of a potential and their widths, by Gauss-Newton steps from many starts.

.. math::
    \tfrac12 \sum_k \bigl\| C_k^{-1/2} (x_k - f(\theta, \xi_k)) \bigr\|^2
    + \tfrac12 \| u \|^2,

A derivative costs a simulation a parameter; no cost grows faster with their number.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from sbi_active.inference.sampling.least_squares import LeastSquares, descend
from sbi_active.inference.sampling.normal_coordinates import NormalCoordinates
from sbi_active.inference.sampling.student_mixture import NormalMixture

Array = NDArray[Any]

STEP = 3e-3  # of differences, in deviations of the prior
WIDER = 1.1  # than the Laplace approximation
FAINT = 0.1  # derivative, which rounding may give, below which more is asked


class Searched(LeastSquares, Protocol):
    """What can be searched."""

    coordinates: NormalCoordinates  # pyright: ignore[reportIncompatibleMethodOverride]
    num_observed: int


@dataclass(frozen=True, kw_only=True)
class SearchSettings:
    """Settings of a search.

    Attributes:
        num_screened: Draws of the prior of which the best begin the first searches;
            twice as many the next; with none, one search begins at each place near. Of
            oscillations a quarter of the searches that begin at the best of 192 end at
            the truth; fewer begin further off.
        num_starts: Searches at a time. Half misses one of eight modes twice as often.
        max_starts: Searches at most.
        num_found: Times that the best mode is to be found, or there are more searches:
            once may be chance.
        explained: Tail probability of the best mode's residuals, below which there are
            more searches: of motions that oscillate, many end in the same wrong place.
        iterations: Steps of a search.
        same: Fall of the cost, in nats times 2, within which two searches found the
            same mode.
        negligible: Rise of the cost beyond which a mode holds no mass.
    """

    num_screened: int = 192
    num_starts: int = 16
    max_starts: int = 64
    num_found: int = 3
    explained: float = 1e-4
    iterations: int = 12
    same: float = 2.0
    negligible: float = 40.0


@dataclass(frozen=True)
class Found:
    """What a search found.

    Attributes:
        guess: A normal component a mode, weighted by its mass.
        modes: Best first, shape (k, d).
        informed: Coordinates that move some trial at a mode or draw, shape (d,).
        num_found: Searches that ended at the best mode.
        num_starts: Searches in all.
        screened: Draws of the prior that were looked at, shape (n, d).
    """

    guess: NormalMixture
    modes: Array
    informed: NDArray[np.bool_]
    num_found: int
    num_starts: int
    screened: Array


def search(
    problem: Searched,
    rng: np.random.Generator,
    near: Array | None = None,
    settings: SearchSettings = SearchSettings(),  # noqa: B008  (frozen)
) -> Found | None:
    r"""Return normal approximations at the modes; None where no search gets anywhere.

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

    References:
        Boender & Rinnooy Kan, Mathematical Programming 37 (1987).
    """
    own, c = settings, problem.coordinates
    every, costs, looked, num = [], [], [], 0
    while True:
        drawn = c.sample(own.num_screened * 2 ** len(looked), rng)
        looked.append(drawn)
        u = np.clip(drawn, c.low, c.high)
        if len(u):
            cost = (problem.residual(u)[0] ** 2).sum(1) + (u**2).sum(1)
            u = u[np.argsort(cost)[: own.num_starts]]
        if near is not None and num == 0:
            u = np.concatenate([np.clip(near, c.low, c.high), u])
        num += len(u)
        u, cost = descend(problem, u, unchanged, STEP, own.iterations)
        every.append(u)
        costs.append(cost)
        u, cost = np.concatenate(every), np.concatenate(costs)
        if not np.isfinite(cost.min()):
            return None
        modes, counts, jac = _apart(problem, u, cost, own)
        ended = sum(counts)
        expected = len(modes) * (ended - 1) / max(ended - len(modes) - 2, 1e-9)
        square = float((problem.residual(u[[cost.argmin()]])[0] ** 2).sum())
        is_found = chi2.sf(square, problem.num_observed) > own.explained
        is_found &= (cost < cost.min() + own.same).sum() >= own.num_found
        is_found &= ended > len(modes) + 2 and expected < len(modes) + 0.5
        if is_found or num >= own.max_starts or not own.num_screened:
            break
    precision = np.einsum("nij,nik->njk", jac, jac) + np.eye(c.dim)
    cov = np.linalg.inv(precision[modes])
    log_mass = -0.5 * cost[modes] - 0.5 * np.linalg.slogdet(precision[modes])[1]
    mass = np.exp(log_mass - log_mass.max())
    # A mode that is worth little is still visited.
    mass = 0.9 * mass / mass.sum() + 0.1 / len(mass)
    factors = WIDER * np.linalg.cholesky(cov)
    return Found(
        NormalMixture(mass, u[modes], factors),
        u[modes],
        np.abs(jac).max((0, 1)) > FAINT,
        int((cost < cost.min() + own.same).sum()),
        num,
        np.concatenate(looked),
    )


def _apart(
    problem: Searched, u: Array, cost: Array, settings: SearchSettings
) -> tuple[list[int], list[int], Array]:
    """Return modes apart from one another, searches at each, and all derivatives."""
    _, jac = problem.jacobian(u, unchanged, STEP)
    precision = np.einsum("nij,nik->njk", jac, jac) + np.eye(problem.dim)
    modes, counts = [], []
    for i in np.argsort(cost):
        if cost[i] >= cost.min() + settings.negligible:
            break
        for place, j in enumerate(modes):
            off = u[i] - u[j]
            if off @ precision[j] @ off < problem.dim + 10:
                counts[place] += 1
                break
        else:
            modes.append(int(i))
            counts.append(1)
    return modes, counts, jac


def unchanged(residual: Array) -> Array:
    """Return residuals as they are: they are whitened already."""
    return residual

r"""Modes and widths of the posterior of many parameters, by Gauss-Newton steps.

.. math::
    \tfrac12 \sum_k \bigl\| C_k^{-1/2} (x_k - f(\theta, \xi_k)) \bigr\|^2
    + \tfrac12 \| u \|^2,

in coordinates u in which the prior is nearly standard normal. A derivative costs a
simulation a parameter; no cost grows faster with their number.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.stats import chi2

from sbi_active.inference.declared.simulated_likelihood import SimulatedLikelihood
from sbi_active.inference.sampling.bridge import NormalMixture
from sbi_active.inference.sampling.least_squares import Whitener, descend
from sbi_active.inference.sampling.normal_coordinates import NormalCoordinates
from sbi_active.simulation.noise.whitening import whitened

Array = NDArray[Any]

STEP = 3e-3  # of differences, in deviations of the prior
SCREENED = 192  # draws of the prior, of which the best begin a search; then twice these
STARTS = 16  # searches at a time
MAX_STARTS = 64
TIMES = 3  # that the best mode is to be found, or there are more searches
EXPLAINED = 1e-4  # tail probability of the best mode's residuals, below which too
ITERATIONS = 12
SAME = 2.0  # fall of the cost within which two searches found the same mode
NEGLIGIBLE = 40.0  # rise of the cost beyond which a mode holds no mass
WIDER = 1.1  # than the Laplace approximation
FAINT = 0.1  # derivative, which rounding may give, below which more is asked
LARGEST = 1e6  # bound on a whitened residual


class WhitenedTrials:
    """Residuals of all trials in deviations of their noise, as functions of u.

    Args:
        likelihood: Of the trials.
        coordinates: In which the prior is nearly standard normal.
    """

    def __init__(
        self, likelihood: SimulatedLikelihood, coordinates: NormalCoordinates
    ) -> None:
        self.likelihood, self.coordinates = likelihood, coordinates
        self.dim = coordinates.dim
        self.searched = np.ones(self.dim, dtype=bool)
        self.num_observed = int(likelihood.x.isfinite().sum())
        self.spread: Array | None = None

    def residual(self, u: Array) -> tuple[Array]:
        """Return residuals, shape (n, N); large where a simulation has no number."""
        theta, parts = self.coordinates.to_theta(u), []
        own = self.likelihood
        for action, x in zip(own.action, own.x, strict=True):
            y, _ = own.table.mean(theta, action)
            if y.shape[1:] != x.shape:  # all rows are lost or without a number
                y = np.full((len(u), *x.shape), np.nan)
            part = whitened(own.noise, (x - torch.from_numpy(y)) / own.inflation)
            part = part.flatten(1).numpy()
            seen = x.isfinite().flatten().numpy()
            parts.append(np.where(seen, part, 0.0))
        r = np.concatenate(parts, 1)
        if self.spread is None:
            filled = np.where(np.isfinite(r), r, np.nan)
            with np.errstate(all="ignore"):
                spread = np.sqrt(np.nanmean(filled**2, 0)) if len(r) else np.ones(1)
            self.spread = np.where(np.isfinite(spread), spread, 0.0)
        r = np.where(np.isfinite(r), r, self.spread)
        return (np.clip(r, -LARGEST, LARGEST),)

    def jacobian(
        self, u: Array, whiten: Whitener, step: float | Array
    ) -> tuple[Array, Array]:
        """Return residuals (n, N) and derivatives (n, N, d)."""
        n, d = u.shape
        steps = np.where(u > 0, -1.0, 1.0) * step  # towards the middle of the prior
        moved = u[:, None] + steps[:, :, None] * np.eye(d)
        stack = np.concatenate([u, moved.reshape(n * d, d)])
        r = whiten(self.residual(stack)[0])
        rest = r[n:].reshape(n, d, -1) - r[:n, None]
        return r[:n], np.swapaxes(rest / steps[:, :, None], 1, 2)


@dataclass(frozen=True)
class Laplace:
    """What a search found.

    Attributes:
        guess: A normal component a mode, weighted by its mass.
        modes: Best first, shape (k, d).
        informed: Coordinates that move some trial at a mode or draw, shape (d,).
        num_found: Searches that ended at the best mode.
        num_starts: Searches in all.
    """

    guess: NormalMixture
    modes: Array
    informed: NDArray[np.bool_]
    num_found: int
    num_starts: int


def find_laplace(
    trials: WhitenedTrials, rng: np.random.Generator, near: Array | None = None
) -> Laplace | None:
    """Return normal approximations at the modes; None where no search gets anywhere.

    Searches begin at the best of some draws of the prior and at points near, and again
    at the best of more draws until the best mode was found several times and explains
    the outcomes: of motions that oscillate, many searches end in the same wrong place,
    whose residuals tell.

    Args:
        trials: Of which the sum of squares is searched.
        rng: Source of the draws.
        near: Where else to begin, shape (k, d).

    References:
        Boender & Rinnooy Kan, Mathematical Programming 37 (1987), for how often a mode
        is to be found.
    """
    c = trials.coordinates
    found, costs, num, screened = [], [], 0, SCREENED
    while num < MAX_STARTS:
        drawn = np.clip(c.sample(screened, rng), c.low, c.high)
        order = np.argsort((trials.residual(drawn)[0] ** 2).sum(1) + (drawn**2).sum(1))
        u = drawn[order[:STARTS]]
        if near is not None and num == 0:
            u = np.concatenate([np.clip(near, c.low, c.high), u])
        num, screened = num + len(u), 2 * screened
        u, cost = descend(trials, u, unchanged, STEP, ITERATIONS)
        found.append(u)
        costs.append(cost)
        known = np.concatenate(costs)
        best = np.concatenate(found)[known.argmin()]
        square = float((trials.residual(best[None])[0] ** 2).sum())
        explains = chi2.sf(square, trials.num_observed) > EXPLAINED
        if explains and (known < known.min() + SAME).sum() >= TIMES:
            break
    u, cost = np.concatenate(found), np.concatenate(costs)
    if not np.isfinite(cost.min()):
        return None
    num_found = int((cost < cost.min() + SAME).sum())
    _, jac = trials.jacobian(u, unchanged, STEP)
    precision = np.einsum("nij,nik->njk", jac, jac) + np.eye(c.dim)
    keep: list[int] = []
    for i in np.argsort(cost):
        near_one = any(
            (u[i] - u[j]) @ precision[j] @ (u[i] - u[j]) < c.dim + 10 for j in keep
        )
        if cost[i] < cost.min() + NEGLIGIBLE and not near_one:
            keep.append(int(i))
    modes, precision = u[keep], precision[keep]
    cov = np.linalg.inv(precision)
    log_mass = -0.5 * cost[keep] - 0.5 * np.linalg.slogdet(precision)[1]
    mass = np.exp(log_mass - log_mass.max())
    # A mode that is worth little is still visited.
    mass = 0.9 * mass / mass.sum() + 0.1 / len(mass)
    factors = WIDER * np.linalg.cholesky(cov)
    informed = np.abs(jac).max((0, 1)) > FAINT
    return Laplace(NormalMixture(mass, modes, factors), modes, informed, num_found, num)


def unchanged(residual: Array) -> Array:
    """Return residuals as they are: they are whitened already."""
    return residual

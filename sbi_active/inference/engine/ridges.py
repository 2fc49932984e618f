"""Narrow proposals along the ridges of a posterior.

If trials determine only the product of two parameters, the posterior is a curved ridge,
as narrow as the trials are precise and as long as the prior. Its width
over its radius of curvature says how short a normal density has to be to stay on it,
so that there are many: some are led to the ridge by least squares, and the others lie
where draws of these count.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from sbi_active.arrays import Array
from sbi_active.inference.engine.potential import Potential
from sbi_active.inference.engine.search import Found
from sbi_active.inference.engine.settings import Settings
from sbi_active.inference.sampling.least_squares import descend, floored
from sbi_active.inference.sampling.mixtures import StudentMixture, lower_factors
from sbi_active.inference.sampling.weights import systematic


@dataclass(frozen=True)
class Ridge:
    """Places along ridges, and how the response bends the density at each.

    Attributes:
        means: Places, shape (k, d).
        curvature: Precision that the trials give there, shape (k, d, d).
        weights: Weights of the places, which sum to 1, shape (k,).
        precision: Precision of the prior, shape (d,).
        num_open: Number of directions that the trials leave open.
        settings: Settings that say how far the places may spread.
    """

    means: Array
    curvature: Array
    weights: Array
    precision: Array
    num_open: int
    settings: Settings

    @cached_property
    def mixture(self) -> StudentMixture:
        """A t distribution at each place, along the ridge as long as they are apart."""
        own, num = self.settings, len(self.means)
        width = min(own.reach * num ** (-1 / self.num_open), 1.0)
        local = self.curvature + np.diag(self.precision / width**2)
        factors = own.laplace_wider * lower_factors(np.linalg.inv(local))
        return StudentMixture(self.means, factors, self.weights)

    def grown(self, u: Array, weight: Array, rng: np.random.Generator) -> Ridge:
        """Return the places whose draws count, and draws that count as further ones.

        Where a place is missing, the draws nearby have the largest weights.

        Args:
            u: Draws, shape (n, d).
            weight: Weights of the draws, which sum to 1, shape (n,).
            rng: Source of the choice of draws.
        """
        own = self.settings
        # Tempered weights: few draws must not shrink the next proposal to a point.
        flat = np.sqrt(weight)
        counts = self.mixture.shares(u, flat / flat.sum()) * len(self.means)
        some = np.unique(systematic(weight, own.num_ridge, rng.random()))
        nearest = self.mixture.log_parts(u[some]).argmax(0)
        kept = counts > own.idle
        weights = np.concatenate(
            [
                0.5 * (counts[kept] + 1) / (counts[kept] + 1).sum(),
                np.full(len(some), 0.5 / len(some)),
            ]
        )
        return replace(
            self,
            means=np.concatenate([self.means[kept], u[some]]),
            curvature=np.concatenate([self.curvature[kept], self.curvature[nearest]]),
            weights=weights,
        )


def along_ridges(
    potential: Potential,
    found: Found,
    points: Array,
    rng: np.random.Generator,
    settings: Settings,
) -> Ridge | None:
    """Return places along the ridges; None if nothing is likely.

    Draws of the normal approximations, and points, are brought back to the ridge by
    steps that a prior around each damps, so that they move across it and not along.

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
    _, jac = potential.jacobian(u, whiten, step)
    curvature = np.einsum("nij,nik->njk", jac, jac)
    equal = np.full(len(u), 1 / len(u))
    return Ridge(u, curvature, equal, precision, num_open, settings)

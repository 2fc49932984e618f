"""Regions of parameter space, and features in which outcomes are regressed."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi, chi2

from sbi_active.arrays import Array
from sbi_active.inference.sampling.coordinates import PriorCoordinates
from sbi_active.inference.sampling.mixtures import fitted_normals


@dataclass(frozen=True)
class Region:
    r"""The ellipsoid :math:`\| L^{-1} (z - c) \| \le R`, or all of the space.

    Attributes:
        center: c, shape (d,).
        factor: L, lower triangular, shape (d, d).
        radius: R.
        whole: Whether the region has no edge; c, L and R then only give a scale.
        inner: Share of R within which the posterior lies. Half of the simulations do,
            and what a basis misses beyond does not shift the prediction there.
    """

    center: Array
    factor: Array
    radius: float
    whole: bool = False
    inner: float = 1.0

    def scaled(self, z: Array) -> Array:
        """Return coordinates of which the region is the unit ball, shape (n, d)."""
        return np.linalg.solve(self.factor, (z - self.center).T).T / self.radius

    def distance(self, z: Array) -> Array:
        """Return 1 on the edge and less inside, shape (n,).

        The whole space is within 1 of everything, so that any ellipsoid is nearer.
        """
        if self.whole:
            return np.ones(len(z))
        return np.sqrt((self.scaled(z) ** 2).sum(1))

    def wider(self, factor: float) -> Region:
        """Return the region that reaches further around the same inner one."""
        radius, inner = factor * self.radius, self.inner / factor
        return replace(self, radius=radius, inner=inner)

    def sample_inside(
        self, num_samples: int, coordinates: PriorCoordinates, rng: np.random.Generator
    ) -> Array:
        """Return at most n places to simulate, in the region and the support.

        They are dense in the middle, where the posterior is; uniform draws would lie
        in the shell.
        """
        if self.whole:
            return coordinates.sample_prior(num_samples, rng)
        kept: list[Array] = []
        missing = num_samples
        for _ in range(20):  # a region may touch the support in a sliver only
            z = self._rays(2 * missing + 20, rng)
            kept.append(z[coordinates.inside(z)][:missing])
            missing -= len(kept[-1])
            if missing == 0:
                break
        if missing > 0:  # as where a box of many sides cuts each ray
            z = coordinates.pulled_inside(self.center, self._rays(missing, rng), rng)
            kept.append(z[coordinates.inside(z)])
        return np.concatenate(kept)

    def _rays(
        self, num_samples: int, rng: np.random.Generator, *, spread: float = 2.2
    ) -> Array:
        """Return normal draws cut at the edge, shape (n, d): a direction and a length.

        The length's distribution is inverted, since of twenty normal numbers hardly
        any fall within the edge. The edge lies at ``spread`` deviations of the draws,
        and in two dimensions at 4 of the posterior, which is narrower.
        """
        d = len(self.center)
        normal = rng.standard_normal((num_samples, d))
        direction = normal / np.linalg.norm(normal, axis=1, keepdims=True)
        level = rng.random((num_samples, 1)) * chi.cdf(spread, d)
        length = self.radius / spread * chi.ppf(level, d)
        if self.inner < 1:
            length *= rng.choice([self.inner, 1.0], (num_samples, 1))
        return self.center + (length * direction) @ self.factor.T


def whole_space(dim: int) -> Region:
    """Return the region without an edge."""
    return Region(np.zeros(dim), np.eye(dim), 1.0, whole=True)


def cover(
    points: Array,
    rng: np.random.Generator,
    *,
    max_regions: int,
    generous: bool,
    wide: bool = False,
    worth: float = 0.1,
    further: float = 2.0,
) -> list[Region]:
    """Return ellipsoids around the clusters of a sample.

    More clusters are taken only where that makes the sample denser by a factor, since
    each needs simulations of its own. Generous ones reach four deviations of each
    cluster; else an ellipsoid just holds its particles, which a surrogate with misfit
    has spread already. Wide ones reach further: the further apart simulations are, the
    better they tell slopes, if the basis still holds. With a factor of 1 the noise of
    slopes moves a mean by .12 deviations of four parameters at 3,000 histories, which
    grows with the numbers in an outcome; with 2 by .08.
    """
    d = points.shape[1]
    counts = [k for k in (1, 2, 3, 4, 6, 8) if k <= max_regions]
    best = fitted_normals(points, counts[0], rng)
    likelihood = float(best.log_prob(points).mean())
    for count in counts[1:]:
        other = fitted_normals(points, count, rng)
        found = float(other.log_prob(points).mean())
        if found > likelihood + worth * d:
            best, likelihood = other, found
    label = best.log_parts(points).argmax(0)
    full = _radius(d)
    regions = []
    for k in range(len(best.means)):
        members = points[label == k]
        if len(np.unique(members, axis=0)) < d + 3:
            continue
        center = members.mean(0)
        shape = Region(center, _factor(members), 1.0)
        farthest = shape.distance(members).max()
        radius = max(full, 1.1 * farthest) if generous else 1.2 * farthest
        region = Region(center, shape.factor, float(radius))
        regions.append(region.wider(further) if wide else region)
    return regions or [around(points)]  # a sample of a few points has no clusters


def around(draws: Array) -> Region:
    """Return the ellipsoid that covers draws, shape (n, d), as of a Gaussian."""
    return Region(draws.mean(0), _factor(draws), _radius(draws.shape[1]))


def _radius(dim: int, *, covered: float = 0.9997) -> float:
    """Return the deviations within which a normal density has a mass."""
    return float(chi2.ppf(covered, dim) ** 0.5)


def _factor(draws: Array, *, finest: float = 1e-6) -> Array:
    """Return the lower Cholesky factor of the covariance of draws (n, d).

    Parameters are simulated in single precision, and draws of a spread below the
    ``finest`` would lie beside it.
    """
    covariance = np.atleast_2d(np.cov(draws.T)) + finest**2 * np.eye(draws.shape[1])
    spread = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(spread, spread)
    return spread[:, None] * np.linalg.cholesky(
        correlation + 1e-9 * np.eye(len(spread))
    )


@dataclass(frozen=True)
class Basis:
    """Monomials up to a degree, random cosines, and a step.

    Attributes:
        degree: Degree of the monomials.
        frequency: Shape (d, w), w = 0 for none.
        phase: Shape (w,).
        is_additive: Whether monomials are powers of one coordinate each.
        inner: Distance from the center beyond which the intercept is another; None has
            one.
    """

    degree: int
    frequency: Array
    phase: Array
    is_additive: bool = False
    inner: float | None = None

    @staticmethod
    def polynomial(degree: int, dim: int, *, is_additive: bool = False) -> Basis:
        """Return a basis without cosines."""
        return Basis(degree, np.zeros((dim, 0)), np.zeros(0), is_additive)

    @staticmethod
    def waves(length: float, dim: int, num: int) -> Basis:
        """Return quadratics and cosines (Rahimi & Recht, NeurIPS 2007)."""
        rng = np.random.default_rng(7)  # any fixed directions will do
        frequency = rng.standard_normal((dim, num)) / length
        return Basis(2, frequency, rng.uniform(0, 2 * np.pi, num))

    @property
    def num_features(self) -> int:
        """Number p of features."""
        dim, num_waves = self.frequency.shape
        num = num_waves + (self.inner is not None)
        if self.is_additive:
            return 1 + self.degree * dim + num
        return math.comb(dim + self.degree, self.degree) + num

    def __call__(self, u: Array) -> Array:
        """Return features, shape (n, p), of coordinates, shape (n, d)."""
        parts = [self._monomials(u)]
        if self.phase.size:
            parts.append(np.cos(u @ self.frequency + self.phase))
        if self.inner is not None:
            parts.append(np.linalg.norm(u, axis=1, keepdims=True) > self.inner)
        return np.concatenate(parts, 1)

    def _monomials(self, u: Array) -> Array:
        if self.is_additive:
            powers = [u**degree for degree in range(1, self.degree + 1)]
            return np.concatenate([np.ones((len(u), 1)), *powers], 1)
        monomials = [np.ones(len(u))]
        last = [(0, monomials[0])]
        for _ in range(self.degree):
            last = [
                (j, column * u[:, j])
                for first, column in last
                for j in range(first, u.shape[1])
            ]
            monomials += [column for _, column in last]
        return np.stack(monomials, 1)

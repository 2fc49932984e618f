r"""Least squares of numbers on parameters, of the basis that predicts them best.

The degree of the polynomials, and how far off simulations may lie, are those that
predict left-out rows near the belief best: distant ones tell slopes well where the
response is simple, and mislead where it is not.

References:
    Lepski, Theory Probab. Appl. 1991 (the widest neighborhood that agrees with the
    narrower ones); Rahimi & Recht, NeurIPS 2007 (cosines).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import comb

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from sbi_active.arrays import Array
from sbi_active.inference.emulation.residuals import ResidualCovariance
from sbi_active.inference.engine.surface import features


@dataclass(frozen=True)
class Region:
    r"""Where one regression holds: :math:`\| L^{-1} (z - c) \| \le R`.

    Attributes:
        center: c, shape (d,).
        factor: L, a lower factor of the covariance of a belief, shape (d, d).
        reach: R; infinite is all of the space.
    """

    center: Array
    factor: Array
    reach: float

    def scaled(self, z: Array) -> Array:
        """Return coordinates in deviations of the belief, shape (n, d)."""
        return np.linalg.solve(self.factor, (z - self.center).T).T

    def distance(self, z: Array) -> Array:
        """Return distances in deviations of the belief, shape (n,)."""
        return np.sqrt((self.scaled(z) ** 2).sum(1))

    def sized(self, z: Array) -> Region:
        """Return the region in coordinates in which rows (n, d) are of unit size."""
        size = np.sqrt((self.scaled(z) ** 2).mean())
        return replace(self, factor=self.factor * max(1.0, float(size)))

    def contains(self, z: Array) -> NDArray[np.bool_]:
        """Return whether places lie inside, shape (n,)."""
        return self.distance(z) <= self.reach

    def nearest(self, z: Array, at_least: int) -> NDArray[np.intp]:
        """Return the places inside, or the nearest few beyond."""
        order = np.argsort(self.distance(z), kind="stable")
        return order[: max(at_least, int(self.contains(z).sum()))]


def whole_space(dim: int) -> Region:
    """Return the region without an edge."""
    return Region(np.zeros(dim), np.eye(dim), np.inf)


def bulk(dim: int, *, covered: float = 0.9997) -> float:
    """Return the deviations within which a normal density has a mass."""
    return float(chi2.ppf(covered, dim) ** 0.5)


def around(draws: Array, *, finest: float = 1e-6, further: float = 2.0) -> Region:
    """Return the region of draws, shape (n, d).

    Args:
        draws: Draws of a belief.
        finest: Deviation at least: parameters are simulated in single precision.
        further: Factor of the distance that it reaches beyond the draws.
    """
    center, dim = draws.mean(0), draws.shape[1]
    covariance = np.atleast_2d(np.cov(draws.T)) + finest**2 * np.eye(dim)
    spread = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(spread, spread) + 1e-9 * np.eye(dim)
    region = Region(center, spread[:, None] * np.linalg.cholesky(correlation), 1.0)
    reach = max(bulk(dim), float(region.distance(draws).max()))
    return Region(center, region.factor, further * reach)


@dataclass(frozen=True)
class Basis:
    """Products of coordinates up to a degree, and random cosines.

    Attributes:
        region: Region that gives the coordinates.
        reach: Distance that is the unit of the coordinates.
        degree: Degree of the products.
        frequency: Frequencies of the cosines, shape (d, w), w = 0 for none.
    """

    region: Region
    reach: float
    degree: int
    frequency: Array

    def __call__(self, z: Array) -> Array:
        """Return features, shape (n, p), of the prior's coordinates, shape (n, d)."""
        u = self.region.scaled(z) / self.reach
        parts = [features(u, self.degree)]
        if self.frequency.size:
            phase = np.linspace(0, 2 * np.pi, self.frequency.shape[1], endpoint=False)
            parts.append(np.cos(u @ self.frequency + phase))
        return np.concatenate(parts, 1)


@dataclass(frozen=True)
class Solved:
    """A basis that was fitted to rows.

    Attributes:
        basis: f.
        coefficient: B of outcomes less the observed ones, shape (p, q).
        root: :math:`R^{-1}` of F = Q R, so that h = |f R^{-1}|^2, shape (p, p).
        near: Which of its rows lie near the belief, shape (n,).
        residual: Residuals of its rows, each as large as without leverage, (n, q).
        score: Log mean square of left-out rows near the belief, summed over numbers.
    """

    basis: Basis
    coefficient: Array
    root: Array
    near: NDArray[np.bool_]
    residual: Array
    score: float

    @property
    def square(self) -> Array:
        """Mean squares of the residuals near the belief, shape (q,)."""
        return (self.residual[self.near] ** 2).mean(0)

    def noise(self, *, unlike: float = 2.0) -> Array:
        """Return the residuals that tell the noise near the belief, shape (m, q).

        They are all, unless those nearby are smaller or larger.

        Args:
            unlike: Square of the logarithm of a ratio of variances, in units of chance,
                mean over numbers, from which on they are.
        """
        ratio = np.log(self.square + 1e-300) - np.log(
            (self.residual**2).mean(0) + 1e-300
        )
        is_unlike = 0.5 * self.near.sum() * (ratio**2).mean() > unlike
        return self.residual[self.near] if is_unlike else self.residual

    def freedom(self, num: int) -> int:
        """Return the degrees of freedom of the residuals of so many rows."""
        return max(int(num * (1 - len(self.root) / len(self.near))), 4)

    def covariance(
        self, trial: NDArray[np.intp], noise: Array
    ) -> tuple[ResidualCovariance, Array]:
        """Return the covariance of the noise, and residuals over their deviations.

        Args:
            trial: Trial of each number, shape (q,).
            noise: Variances of the noise, shape (q,), of which a share is a floor.
        """
        residual = self.noise()
        square, freedom = (residual**2).mean(0), self.freedom(len(residual))
        floor = 1e-9 * np.minimum(noise, square.max()) + 1e-300
        deviation = np.sqrt(square + floor)
        standardized = residual / deviation * (freedom / len(residual)) ** 0.5
        own = ResidualCovariance.of(standardized, deviation, freedom, trial)
        return own, standardized


def solved(
    basis: Basis,
    z: Array,
    x: Array,
    near: NDArray[np.bool_],
    *,
    freedom: int = 20,
) -> Solved | None:
    """Return the least-squares fit of a basis; None where rows are too few.

    Args:
        basis: Features.
        z: Coordinates of simulations, shape (n, d).
        x: Outcomes, shape (n, q).
        near: Which of them lie near the belief, shape (n,).
        freedom: Degrees of freedom at least, which know a variance to a third.
    """
    has_waves, n = basis.frequency.size > 0, len(z)
    p = comb(z.shape[1] + basis.degree, basis.degree) + basis.frequency.shape[1]
    if n < p + max(min(freedom, n // 3), p // 2):
        return None
    rows = basis(z)
    ridge = np.diag(np.full(p, 1e-4 if has_waves else 1e-9))
    orthogonal, triangular = np.linalg.qr(np.concatenate([rows, ridge]))
    root = np.linalg.inv(triangular)
    coefficient = root @ (orthogonal[:n].T @ x)
    error = x - rows @ coefficient
    left = np.maximum(1 - (orthogonal[:n] ** 2).sum(1), 1e-3)[:, None]
    square = ((error / left)[near] ** 2).mean(0)
    score = float(np.log(square + 1e-12 * x.var(0) + 1e-300).sum())
    return Solved(basis, coefficient, root, near, error / np.sqrt(left), score)


def best_solved(
    region: Region,
    z: Array,
    x: Array,
    noise: Array,
    *,
    fewest: int = 60,
    degrees: tuple[int, ...] = (0, 1, 2, 3),
    lengths: tuple[float, ...] = (1.0, 0.5, 0.25),
    most_waves: int = 120,
    more: float = 1.3,
    rough: float = 3.0,
    gain: float = 0.001,
) -> tuple[Solved, Solved]:
    """Return the polynomial that predicts left-out rows near the belief best.

    Adds cosines where these do better.

    Args:
        region: Region of the belief.
        z: Coordinates of simulations, shape (n, d).
        x: Outcomes, shape (n, q).
        noise: Variances of the noise, shape (q,).
        fewest: Number of rows that count as near at least.
        degrees: Degrees that are tried.
        lengths: Lengths of cosines that are tried, in the unit of the coordinates.
        most_waves: Number of cosines at most.
        more: Factor of the number of rows by which a further reach has to gain.
        gain: Nats a number that a higher degree must save.
        rough: Residual over noise variance of some number from which on cosines are
            tried.
    """
    dim, distance = z.shape[1], region.distance(z)
    closest = np.sort(distance)[: fewest + dim]
    limit = max(bulk(dim), float(closest[-1]))
    if np.isinf(region.reach):
        limit = max(float(distance.max()), 1e-300)
    reaches = limit * 2.0 ** np.arange(12)
    fits: list[Solved] = []
    last = 0.0
    none = np.zeros((dim, 0))
    for reach in reaches:
        rows = distance <= reach
        if rows.sum() < more * last:
            continue
        last = rows.sum()
        near = distance[rows] <= limit
        for degree in degrees:
            fit = solved(Basis(region, reach, degree, none), z[rows], x[rows], near)
            if fit is not None:
                fits.append(fit)
        if last == len(z):
            break

    def cost(fit: Solved) -> float:
        """Return the score, and what is asked of a higher degree."""
        return fit.score + gain * x.shape[1] * fit.basis.degree

    # Where rows are few a constant predicts best, and would say that a trial tells
    # nothing; slopes that are not known have an error, which is known.
    sloped = [fit for fit in fits if fit.basis.degree]
    best = polynomial = min(sloped or fits, key=cost)
    if not (best.square > rough * noise).any():
        return best, best
    rng = np.random.default_rng(7)  # any fixed directions will do
    rows = distance <= best.basis.reach
    near = distance[rows] <= limit
    frequency = rng.standard_normal((dim, min(most_waves, int(rows.sum()) // 4)))
    for length in lengths:
        basis = Basis(region, best.basis.reach, 2, frequency / length)
        fit = solved(basis, z[rows], x[rows], near)
        if fit is not None and fit.score < best.score:
            best = fit
    return best, polynomial

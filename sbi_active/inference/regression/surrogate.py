r"""A likelihood learned by regression of outcomes on parameters, region by region.

In a region the stacked outcomes of all trials are modeled as

.. math::
    x \mid \theta \sim \mathcal N\big(B^\top f(u),\; (1 + h(u))\, S\big), \qquad
    h(u) = f(u)^\top (F^\top F)^{-1} f(u),

with f a basis in the region's own coordinates u, S the covariance of the residuals,
which holds the noise and what the basis misses, and h the leverage, by which the
likelihood widens where simulations are few. Regressing x on theta asks nothing of
where the simulations lie, so there is no proposal to correct for. Numbers that were
not observed have no part in it, and the probability of what each trial's outcome was,
a measurement or none, is a further factor
(:mod:`.outcomes`).

References:
    Wood, Nature 2010 (synthetic likelihood).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2, f

from sbi_active.arrays import Array
from sbi_active.inference.regression.outcomes import TrialOutcome
from sbi_active.inference.regression.regions import Basis, Region
from sbi_active.inference.regression.residuals import (
    NoiseShape,
    ResidualCovariance,
    ShapeSettings,
    alike,
)
from sbi_active.inference.sampling.coordinates import PriorCoordinates


def noise_variance(first: Array, second: Array, scale: Array) -> Array:
    """Return the variance of pairs of outcomes at the same parameters, shape (q,).

    Each is of shape (r, q). The rounding of the largest size of each outcome, shape
    (q,), is a floor.
    """
    variance = 0.5 * ((first - second) ** 2).mean(0)
    rounding = float(np.finfo(np.float32).eps) * scale  # outcomes are float32
    return variance + rounding**2 + 1e-300


@dataclass(frozen=True)
class LocalRegression:
    r"""Regression of the outcomes, less the observed ones, in one region.

    Attributes:
        region: Region where it holds.
        basis: f.
        coefficient: :math:`B L^{-\top}`, outcomes whitened by S = L L^T, shape (p, q).
        root: :math:`R^{-1}` of F = Q R, so that h = |f R^{-1}|^2, shape (p, p).
        outcomes: Probability of a measurement, or of none, of each trial in which
            simulations do not all agree.
        used: Which outcomes were observed, shape (q,); all others have no coefficient
            and no residual.
        roughness: Share of the variance of some outcome that a cubic misses.
        ratio: Residual over noise variance, mean over outcomes.
        excess: This ratio with chance removed, and more of many numbers, whose misfit
            adds up: above 1 means misfit.
        residual: Whitened residuals, shape (n, q).
        standardized: Residuals over their deviations, not rotated, shape (n, q).
        covariance: S, of the outcomes in use.
        shape: Another density of the noise, not Gaussian; None where that is none.
    """

    region: Region
    basis: Basis
    coefficient: Array
    root: Array
    outcomes: tuple[TrialOutcome, ...]
    used: NDArray[np.bool_]
    roughness: float
    ratio: float
    excess: float
    residual: Array
    standardized: Array
    covariance: ResidualCovariance
    shape: NoiseShape | None = None

    def __getstate__(self) -> dict[str, Any]:
        # Residuals have served the diagnostics and would only weigh on a pickle.
        empty = np.zeros((0, len(self.used)))
        return {**vars(self), "residual": empty, "standardized": empty}

    @property
    def has_misfit(self) -> bool:
        """Whether the residuals are larger than the noise."""
        return is_misfit(self.excess)

    @staticmethod
    def fit(
        region: Region,
        z: Array,
        x: Array,
        *,
        noise: Array,
        num_pairs: int,
        num_trials: int,
        outcomes: tuple[TrialOutcome, ...] = (),
        used: NDArray[np.bool_] | None = None,
        observed: Array | None = None,
        shapes: ShapeSettings | None = None,
        gain: float = 0.005,
        freedom: int = 20,
    ) -> LocalRegression | None:
        """Fit the basis with the smallest generalized cross-validation score.

        Args:
            region: Where the simulations lie.
            z: Their coordinates, shape (n, d).
            x: Their outcomes less the observed ones, shape (n, q).
            noise: Variance of the noise in the region, of the outcomes in use.
            num_pairs: Number of pairs of outcomes behind it.
            num_trials: Trials stacked in q.
            outcomes: Whether trials gave a measurement.
            used: Outcomes that were observed, shape (q,); None is all.
            observed: What was observed, shape (q,), for a noise that grows with it.
            shapes: Settings of noise that is not Gaussian; None takes it for Gaussian.
            gain: Nats an outcome that a larger basis must save.
            freedom: Degrees of freedom at least, which know a variance to a third.

        Returns:
            The regression; None where simulations are too few.
        """
        used = np.ones(x.shape[1], dtype=bool) if used is None else used
        trial = np.repeat(np.arange(num_trials), x.shape[1] // num_trials)[used]
        x = x[:, used]
        n, q = x.shape
        u = region.scaled(z)
        scale = np.sqrt(noise)
        best: tuple[float, Basis, Array, Array, Array, Array] | None = None
        roughness = 0.0
        is_inner = np.linalg.norm(u, axis=1) <= region.inner
        # Both intercepts are to be known.
        is_split = region.inner < 1
        is_split &= min(is_inner.sum(), (~is_inner).sum()) >= 2 * freedom
        for basis in _candidates(u.shape[1], n):
            if is_split:
                basis = replace(basis, inner=region.inner)
            is_wave = basis.phase.size > 0
            if is_wave and best is not None and best[5].max(initial=0.0) < 3:
                break  # a cubic will do, or another stage makes it do
            p = basis.num_features
            if n < p + max(freedom, p // 2):
                continue
            features = basis(u)
            ridge = np.diag(np.full(p, 1e-4 if is_wave else 1e-9))
            orthogonal, triangular = np.linalg.qr(np.concatenate([features, ridge]))
            root = np.linalg.inv(triangular)
            coefficient = root @ (orthogonal[:n].T @ x)
            residual = x - features @ coefficient
            variance = ((residual / scale) ** 2).sum(0) / (n - p) + 1e-12
            score = np.log(variance).sum() + q * np.log(n / (n - p))
            if not is_wave and q > 0:
                missed = (residual**2).sum(0) / (n - p) - noise
                roughness = float((missed / x.var(0).clip(noise)).max())
            if best is None or score < best[0] - gain * q:
                ratio = (residual**2).sum(0) / (n - p) / noise
                best = (score, basis, root, residual, coefficient, ratio)
        if best is None:
            return None
        _, basis, root, residual, coefficient, ratio = best
        left = n - len(root)
        deviation = np.sqrt((residual**2).sum(0) / left + 1e-9 * noise)
        standardized = residual / deviation
        excess = _excess(ratio, alike(standardized, left), left, num_pairs)
        covariance = ResidualCovariance.of(standardized, deviation, left, trial)
        shape = None
        if shapes is not None and observed is not None:
            shape = NoiseShape.fit(
                *(basis(u), coefficient, residual, observed[used], trial, shapes)
            )
        return LocalRegression(
            shape=shape,
            region=region,
            basis=basis,
            coefficient=_spread(covariance.whiten(coefficient), used),
            root=root,
            outcomes=outcomes,
            used=used,
            roughness=roughness,
            ratio=float(ratio.mean()) if q > 0 else 1.0,
            excess=excess,
            residual=_spread(covariance.whiten(residual), used),
            standardized=_spread(standardized, used),
            covariance=covariance,
        )

    def whitened(self, z: Array) -> tuple[Array, Array]:
        """Return the whitened prediction less the observed (n, q), and 1 + h (n,)."""
        features = self.basis(self.region.scaled(z))
        leverage = ((features @ self.root) ** 2).sum(1)
        return features @ self.coefficient, 1 + leverage

    def whitened_outcomes(self, x: Array) -> Array:
        """Return outcomes less the observed ones, whitened, shape (n, q)."""
        return _spread(self.covariance.whiten(x[:, self.used]), self.used)

    @cached_property
    def compact(self) -> Array:
        """Fewest numbers whose squares add up to those of the outcomes, (p, min(p, q)).

        An orthogonal map of the whitened outcomes, many of which are linear in others
        where there are more outcomes than features.
        """
        p, q = self.coefficient.shape
        return self.coefficient if q <= p else np.linalg.qr(self.coefficient.T)[1].T

    def caution(self, *, least: float = 2.0) -> float:
        """Factor of the variance that keeps what the misfit would wrongly exclude.

        Misfit is no noise: it is the same at each visit, and where the posterior lies
        it may be as large as anywhere in the region. So the largest residual shall
        count as an ordinary one, and misfit for a factor of 2 at least (a choice).
        """
        if not self.has_misfit:
            return 1.0
        n = len(self.residual)
        square = (self.residual**2).sum(1) * n / (n - len(self.root))
        return float(max(least, square.max() / chi2.ppf(0.9, self.used.sum())))

    def log_likelihood(self, z: Array, caution: float = 1.0) -> Array:
        """Return the log likelihood of the observation, (n, d) -> (n,)."""
        features = self.basis(self.region.scaled(z))
        widening = 1 + ((features @ self.root) ** 2).sum(1)
        q = int(self.used.sum())
        square = ((features @ self.compact) ** 2).sum(1)
        square = square * self.covariance.precision / (widening * caution)
        log_volume = self.covariance.log_volume + 0.5 * q * np.log(
            2 * np.pi * widening * caution
        )
        log_likelihood = -0.5 * square - log_volume
        if self.shape is not None:
            other = self.shape.log_likelihood(features, widening * caution)
            log_likelihood = 0.5 * (log_likelihood + other)
        for outcome in self.outcomes:
            log_likelihood = log_likelihood + outcome.log_prob(z)
        return log_likelihood


@dataclass(frozen=True)
class Surrogate:
    """Prior times learned likelihood of all trials, each place in its nearest region.

    Attributes:
        coordinates: Coordinates of the prior.
        regressions: One a region.
        is_cautious: Whether regions with misfit are taken with their caution, to find
            where to simulate next and not what to believe.
    """

    coordinates: PriorCoordinates
    regressions: list[LocalRegression]
    is_cautious: bool = False

    def log_likelihood(self, z: Array) -> Array:
        """Return the log likelihood, shape (n,); -inf outside all regions."""
        label = self.assign(z)
        log_likelihood = np.full(len(z), -np.inf)
        for k, regression in enumerate(self.regressions):
            rows = np.flatnonzero(label == k)
            if len(rows):
                caution = regression.caution() if self.is_cautious else 1.0
                log_likelihood[rows] = regression.log_likelihood(z[rows], caution)
        return log_likelihood

    def assign(self, z: Array) -> NDArray[np.intp]:
        """Return the region of each place, shape (n,); -1 where there is none."""
        distance = np.stack([fit.region.distance(z) for fit in self.regressions])
        return np.where(distance.min(0) <= 1, distance.argmin(0), -1)


def fewest_rows(dim: int, *, freedom: int = 20) -> int:
    """Return the rows that a linear regression on so many parameters takes."""
    return 1 + dim + freedom


def is_misfit(excess: float, *, most: float = 1.12) -> bool:
    """Return whether a basis misses something, by residual over noise variance."""
    return excess > most


def _candidates(
    dim: int,
    num_rows: int,
    *,
    many: int = 6,
    max_waves: int = 120,
    lengths: tuple[float, ...] = (1.0, 0.5, 0.25),
) -> list[Basis]:
    polynomials = [Basis.polynomial(degree, dim) for degree in (1, 2, 3)]
    if dim > many:  # products of two parameters each would need too many rows
        powers = [Basis.polynomial(d, dim, is_additive=True) for d in (2, 3)]
        polynomials = [polynomials[0], *powers, *polynomials[1:]]
    num_waves = min(max_waves, num_rows // 4)
    return polynomials + [Basis.waves(s, dim, num_waves) for s in lengths]


def _excess(
    ratio: Array,
    num_alike: float,
    freedom: int,
    num_pairs: int,
    *,
    chance: float = 0.03,
    numbers: int = 20,
) -> float:
    """Return the misfit, residual over noise variance (q,), with chance removed.

    The mean over outcomes is sharp where all are missed a little, and counts as often
    as there are outcomes; the maximum is where one is missed. Each is less what chance
    alone reaches, but for ``chance``: ratios are F distributed and correlate as the
    squares of the residuals' correlations. Of more than ``numbers``, less misfit of
    each is as bad, since what is missed is smooth and adds up: 3 % of the variance of
    1,000 numbers moved a mean by .8 deviations. At 20 the largest shift of four seeds
    is .25, at 10 .44 and at 40 .20.
    """
    q = len(ratio)
    if q == 0:
        return 0.0
    deviation = np.sqrt(2 / freedom + 2 / max(num_pairs, 1))
    mean = ratio.mean() - 3 * deviation * np.sqrt(num_alike / q)
    mean = 1 + (mean - 1) * max(1.0, q / numbers)
    largest = ratio.max() / f.isf(chance / q, freedom, max(num_pairs, 1))
    return float(max(mean, largest))


def _spread(columns: Array, used: NDArray[np.bool_]) -> Array:
    """Return columns (n, used) at their places among all, (n, q), zero elsewhere."""
    if used.all():
        return columns
    full = np.zeros((len(columns), len(used)))
    full[:, used] = columns
    return full

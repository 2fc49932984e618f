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
(:mod:`~sbi_active.inference.validity`).

References:
    Wood, Nature 2010 (synthetic likelihood); Schafer & Strimmer, Stat. Appl. Genet.
    Mol. Biol. 2005 (shrinkage); Hartlap et al., A&A 2007 (inverse of a covariance).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import get_lapack_funcs
from scipy.stats import chi2, f

from sbi_active.inference.basis import Basis
from sbi_active.inference.coordinates import PriorCoordinates
from sbi_active.inference.regions import Region, nearest_region
from sbi_active.inference.validity import TrialOutcome

__all__ = ["LocalRegression", "NoiseEstimate", "Surrogate", "estimate_noise"]

Array = NDArray[Any]

CAUTION = 2.0  # at least, under misfit
MISFIT = 1.12  # residual over noise variance above which the basis misses something
MANY = 6  # parameters beyond which bases without products are tried too
CHANCE = 0.03  # that the largest ratio is taken for misfit where there is none
GAIN = 0.005  # nats an outcome that a larger basis must save
MAX_WAVES = 120  # random Fourier features
WAVE_LENGTHS = (1.0, 0.5, 0.25)  # in half-widths of the region
FLOAT32 = 2.0**-23  # outcomes are float32: their rounding is a floor of the noise


@dataclass(frozen=True)
class NoiseEstimate:
    """Noise from pairs of outcomes at the same parameters.

    Attributes:
        variance: Of each outcome, shape (q,).
        num_pairs: How many pairs it rests on.
    """

    variance: Array
    num_pairs: int


def estimate_noise(first: Array, second: Array, scale: Array) -> NoiseEstimate:
    """Return the noise of pairs of outcomes, each of shape (r, q).

    Args:
        first: Outcomes.
        second: Outcomes at the same parameters.
        scale: Largest size of each outcome, shape (q,), whose rounding is a floor.
    """
    variance = 0.5 * ((first - second) ** 2).mean(0)
    return NoiseEstimate(variance + (FLOAT32 * scale) ** 2 + 1e-300, len(first))


@dataclass(frozen=True)
class LocalRegression:
    r"""Regression of the outcomes, less the observed ones, in one region.

    Attributes:
        region: Where it holds.
        basis: f.
        coefficient: :math:`B L^{-\top}`, outcomes whitened by S = L L^T, shape (p, q).
        root: :math:`R^{-1}` of F = Q R, so that h = |f R^{-1}|^2, shape (p, p).
        log_volume: log det L.
        precision: Factor that makes the inverse of the sample covariance unbiased.
        outcomes: Probability of a measurement, or of none, of each trial in which
            simulations do not all agree.
        used: Which outcomes were observed, shape (q,); all others have no coefficient
            and no residual.
        roughness: Share of the variance of some outcome that a cubic misses.
        ratio: Residual over noise variance, mean over outcomes.
        excess: The same with chance removed: above 1 means misfit.
        residual: Whitened residuals, shape (n, q).
        standardized: Residuals over their deviations, not rotated, shape (n, q).
        whitening: :math:`L^{-1}`, shape (q, q).
        deviation: Of the residuals, shape (q,), of the outcomes in use.
        leverage: h of the simulations, as part of the fit, shape (n,).
        shrinkage: Of the correlations within a trial and across trials, 1 where S has
            none.
    """

    region: Region
    basis: Basis
    coefficient: Array
    root: Array
    log_volume: float
    precision: float
    outcomes: tuple[TrialOutcome, ...]
    used: NDArray[np.bool_]
    roughness: float
    ratio: float
    excess: float
    residual: Array
    standardized: Array
    whitening: Array
    deviation: Array
    leverage: Array
    shrinkage: tuple[float, float]

    @property
    def has_misfit(self) -> bool:
        """Whether the residuals are larger than the noise."""
        return self.excess > MISFIT

    @staticmethod
    def fit(
        region: Region,
        z: Array,
        x: Array,
        *,
        noise: NoiseEstimate,
        num_trials: int,
        outcomes: tuple[TrialOutcome, ...] = (),
        used: NDArray[np.bool_] | None = None,
    ) -> LocalRegression | None:
        """Fit the basis with the smallest generalized cross-validation score.

        Args:
            region: Where the simulations lie.
            z: Their coordinates, shape (n, d).
            x: Their outcomes less the observed ones, shape (n, q).
            noise: Noise in the region, of the outcomes in use.
            num_trials: Trials stacked in q.
            outcomes: Whether trials gave a measurement.
            used: Outcomes that were observed, shape (q,); None is all.

        Returns:
            The regression; None where simulations are too few.
        """
        used = np.ones(x.shape[1], dtype=bool) if used is None else used
        trial = np.repeat(np.arange(num_trials), x.shape[1] // num_trials)[used]
        x = x[:, used]
        n, q = x.shape
        u = region.scaled(z)
        scale = np.sqrt(noise.variance)
        best: tuple[float, Basis, Array, Array, Array] | None = None
        roughness = 0.0
        for basis in _candidates(u.shape[1], n):
            is_wave = basis.phase.size > 0
            if is_wave and best is not None and _misfit(best[3], noise, best[2]) < 3:
                break  # a cubic will do, or another stage makes it do
            p = basis.num_features
            if n < p + max(20, p // 2):
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
                missed = (residual**2).sum(0) / (n - p) - noise.variance
                roughness = float((missed / x.var(0).clip(noise.variance)).max())
            if best is None or score < best[0] - GAIN * q:
                best = (score, basis, root, residual, coefficient)
        if best is None:
            return None
        _, basis, root, residual, coefficient = best
        freedom = n - len(root)
        ratio = (residual**2).sum(0) / freedom / noise.variance
        deviation = np.sqrt((residual**2).sum(0) / freedom + 1e-9 * noise.variance)
        standardized = residual / deviation
        correlation = standardized.T @ standardized / freedom
        excess = _excess(ratio, correlation, freedom, noise.num_pairs)
        correlation, precision, shrinkage = _shrunk(
            correlation, freedom, trial, excess <= MISFIT
        )
        # Trials with nothing in common apart: a ninth of the time for three.
        groups = trial if shrinkage[1] == 1 else np.zeros_like(trial)
        inverse, log_volume = _whitening(
            correlation * np.outer(deviation, deviation), groups
        )
        return LocalRegression(
            region=region,
            basis=basis,
            coefficient=_spread(coefficient @ inverse.T, used),
            root=root,
            log_volume=log_volume,
            precision=precision,
            outcomes=outcomes,
            used=used,
            roughness=roughness,
            ratio=float(ratio.mean()) if q > 0 else 1.0,
            excess=excess,
            residual=_spread(residual @ inverse.T, used),
            standardized=_spread(standardized, used),
            whitening=inverse,
            deviation=deviation,
            leverage=((basis(u) @ root) ** 2).sum(1),
            shrinkage=shrinkage,
        )

    def whitened(self, z: Array) -> tuple[Array, Array]:
        """Return the whitened prediction less the observation, and 1 + h.

        Args:
            z: Shape (n, d).

        Returns:
            Shapes (n, q) and (n,).
        """
        features = self.basis(self.region.scaled(z))
        leverage = ((features @ self.root) ** 2).sum(1)
        return features @ self.coefficient, 1 + leverage

    @cached_property
    def compact(self) -> Array:
        """Fewest numbers whose squares add up to those of the outcomes, (p, min(p, q)).

        An orthogonal map of the whitened outcomes, many of which are linear in others
        where there are more outcomes than features.
        """
        p, q = self.coefficient.shape
        return self.coefficient if q <= p else np.linalg.qr(self.coefficient.T)[1].T

    @property
    def caution(self) -> float:
        """Factor of the variance that keeps what the misfit would wrongly exclude.

        Misfit is no noise: it is the same at each visit, and where the posterior lies
        it may be as large as anywhere in the region. So the largest residual shall
        count as an ordinary one.
        """
        if not self.has_misfit:
            return 1.0
        n = len(self.residual)
        square = (self.residual**2).sum(1) * n / (n - len(self.root))
        return float(max(CAUTION, square.max() / chi2.ppf(0.9, self.used.sum())))

    def log_likelihood(self, z: Array, caution: float = 1.0) -> Array:
        """Return the log likelihood of the observation, shape (n,).

        Args:
            z: Shape (n, d).
            caution: Factor of the variance.
        """
        features = self.basis(self.region.scaled(z))
        widening = 1 + ((features @ self.root) ** 2).sum(1)
        q = int(self.used.sum())
        square = ((features @ self.compact) ** 2).sum(1)
        square = square * self.precision / (widening * caution)
        log_volume = self.log_volume + 0.5 * q * np.log(2 * np.pi * widening * caution)
        log_likelihood = -0.5 * square - log_volume
        for outcome in self.outcomes:
            log_likelihood = log_likelihood + outcome.log_prob(z)
        return log_likelihood


@dataclass(frozen=True)
class Surrogate:
    """Prior times learned likelihood of all trials, each place in its nearest region.

    Attributes:
        coordinates: Of the prior.
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
                caution = regression.caution if self.is_cautious else 1.0
                log_likelihood[rows] = regression.log_likelihood(z[rows], caution)
        return log_likelihood

    def log_joint(self, z: Array) -> Array:
        """Return log prior plus log likelihood in the coordinates z, shape (n,)."""
        log_joint = self.coordinates.log_prior(z)
        rows = np.flatnonzero(np.isfinite(log_joint))
        log_joint[rows] += self.log_likelihood(z[rows])
        return log_joint

    def assign(self, z: Array) -> NDArray[np.intp]:
        """Return the region of each place, shape (n,); -1 where there is none."""
        return nearest_region([r.region for r in self.regressions], z)


def _candidates(dim: int, num_rows: int) -> list[Basis]:
    polynomials = [Basis.polynomial(degree, dim) for degree in (1, 2, 3)]
    if dim > MANY:  # products of two parameters each would need too many rows
        powers = [Basis.polynomial(d, dim, is_additive=True) for d in (2, 3)]
        polynomials = [polynomials[0], *powers, *polynomials[1:]]
    num_waves = min(MAX_WAVES, num_rows // 4)
    return polynomials + [Basis.waves(s, dim, num_waves) for s in WAVE_LENGTHS]


def _misfit(residual: Array, noise: NoiseEstimate, root: Array) -> float:
    variance = (residual**2).sum(0) / (len(residual) - len(root))
    return float((variance / noise.variance).max(initial=0.0))


def _excess(ratio: Array, correlation: Array, freedom: int, num_pairs: int) -> float:
    r"""Return the misfit, residual over noise variance, with chance removed.

    The mean over outcomes is sharp where all are missed a little, the maximum where
    one is missed; each less what chance alone reaches: ratios are F distributed, their
    squares correlate as :math:`r_{ij}^2`.

    Args:
        ratio: Of the outcomes, shape (q,).
        correlation: Of the residuals, shape (q, q).
        freedom: Rows less coefficients.
        num_pairs: That the noise is known from.
    """
    q = len(ratio)
    if q == 0:
        return 0.0
    deviation = np.sqrt(2 / freedom + 2 / max(num_pairs, 1))
    alike = ((correlation**2).sum() - q * (q - 1) / freedom).clip(q) / q
    mean = ratio.mean() - 3 * deviation * np.sqrt(alike / q)
    largest = ratio.max() / f.isf(CHANCE / q, freedom, max(num_pairs, 1))
    return float(max(mean, largest))


def _shrunk(
    correlation: Array, freedom: int, trial: NDArray[np.intp], independent: bool
) -> tuple[Array, float, tuple[float, float]]:
    r"""Return residuals' correlation, the factor of its inverse, and the shrinkage.

    Correlations shrink by :math:`\lambda = \sum \mathrm{Var}(r_{ij}) / \sum r_{ij}^2`,
    apart within a trial and across trials. Noise does not correlate across trials,
    which are independent given theta; misfit does.

    Args:
        correlation: Shape (q, q).
        freedom: Rows less coefficients.
        trial: Of each outcome, shape (q,).
        independent: Whether there is no misfit.
    """
    q = len(correlation)
    if q == 0:
        return correlation, 1.0, (1.0, 1.0)
    within = trial[:, None] == trial
    diagonal = np.eye(q, dtype=bool)
    across = 1.0 if independent else _shrinkage(correlation[~within], freedom)
    shrunk = _shrinkage(correlation[within & ~diagonal], freedom)
    correlation = np.where(within, correlation, (1 - across) * correlation)
    correlation = np.where(diagonal, 1.0, (1 - shrunk) * correlation)
    size = q if across < 1 else int(np.bincount(trial).max())
    free = 1 + (size - 1) * (1 - shrunk) ** 2
    precision = max((freedom - free - 1) / freedom, 0.2)
    return correlation, precision, (shrunk, across)


def _whitening(covariance: Array, group: NDArray[np.intp]) -> tuple[Array, float]:
    """Return the inverse Cholesky factor, and the log determinant of the factor.

    Args:
        covariance: Shape (q, q), zero between groups.
        group: Of each outcome, shape (q,).
    """
    inverse, log_volume = np.zeros_like(covariance), 0.0
    (invert,) = get_lapack_funcs(("trtri",), (covariance,))
    for label in np.unique(group):
        rows = np.flatnonzero(group == label)
        place = np.ix_(rows, rows)
        factor = np.linalg.cholesky(covariance[place])
        log_volume += float(np.log(np.diag(factor)).sum())
        inverse[place], _ = invert(factor, lower=1)
    return inverse, log_volume


def _shrinkage(correlation: Array, freedom: int) -> float:
    if correlation.size == 0:
        return 1.0
    variance = (1 - correlation**2) ** 2 / freedom
    return float(min(1.0, variance.sum() / max((correlation**2).sum(), 1e-300)))


def _spread(columns: Array, used: NDArray[np.bool_]) -> Array:
    """Return columns (n, used) at their places among all, (n, q), zero elsewhere."""
    if used.all():
        return columns
    full = np.zeros((len(columns), len(used)))
    full[:, used] = columns
    return full

r"""Covariance of a regression's residuals, many of which may be numbers of one trial.

References:
    Schafer & Strimmer, Stat. Appl. Genet. Mol. Biol. 2005 (shrinkage); Hartlap et al.,
    A&A 2007 (inverse of a covariance).

Noise that is not Gaussian: residuals as a mixture, of a size that may grow.

A second likelihood of a regression is not Gaussian. It uses the same prediction m and
its residuals,

.. math::
    e_j = \frac{x_j - m_j(\theta)}{c_j\, s_j(\theta)}, \qquad
    s_j(\theta) = \bigl(m_j(\theta)^2 + f_j^2\bigr)^{\beta / 2}, \qquad
    y_j = \Phi^{-1}\bigl(F(e_j)\bigr),

with one power :math:`\beta` and one mixture F of normal distributions for the residuals
of all numbers, and y normal with a covariance (a Gaussian copula). Neither likelihood
is right, and which is closer at the observation is not known: few residuals lie there.
So a belief takes the geometric mean of both,

.. math::
    \mathrm{KL}\bigl(p \,\|\, \propto \sqrt{g h}\bigr)
    = \tfrac12 \mathrm{KL}(p \| g) + \tfrac12 \mathrm{KL}(p \| h)
    + \log \int \sqrt{g h},

whose last term is negative, the more so the less g and h agree.

References:
    Heskes, NeurIPS 1998 (logarithmic opinion pools); Carroll & Ruppert, Transformation
    and Weighting in Regression, 1988 (a power of the mean).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import get_lapack_funcs
from scipy.optimize import minimize_scalar
from scipy.special import ndtr, ndtri

from sbi_active.arrays import Array
from sbi_active.inference.sampling.mixtures import StudentMixture, fitted_normals


@dataclass(frozen=True)
class ResidualCovariance:
    r"""Covariance S = L L^T with shrunk correlations within each trial.

    Correlations shrink by :math:`\lambda = \sum \mathrm{Var}(r_{ij}) / \sum r_{ij}^2`.
    There are none across trials, which are independent given theta.

    Attributes:
        deviation: Deviation of the residuals, shape (q,).
        blocks: Outcomes of each trial, and the inverse Cholesky factor of their
            correlation.
        freedom: Degrees of freedom of the residuals.
        freedoms: Those of the density of each trial's numbers.
        precision: Factor that makes the inverse of the sample covariance unbiased.
        log_volume: log det L.
    """

    deviation: Array
    blocks: tuple[tuple[NDArray[np.intp], Array], ...]
    freedom: int
    freedoms: tuple[float, ...]
    precision: float
    log_volume: float

    @property
    def maps(self) -> list[tuple[NDArray[np.intp], Array]]:
        """Numbers of each trial, and the map that whitens them."""
        return [(own, (inv / self.deviation[own]).T) for own, inv in self.blocks]

    @staticmethod
    def of(
        standardized: Array, deviation: Array, freedom: int, trial: NDArray[np.intp]
    ) -> ResidualCovariance:
        """Return the covariance of residuals over their deviations, shape (n, q).

        Args:
            standardized: The residuals.
            deviation: Shape (q,).
            freedom: Rows less coefficients.
            trial: Trial of each outcome, shape (q,).
        """
        q = len(deviation)
        rows = [np.flatnonzero(trial == k) for k in np.unique(trial)]
        correlations = [
            standardized[:, r].T @ standardized[:, r] / freedom for r in rows
        ]
        square = np.concatenate([np.zeros(0), *(c.ravel() ** 2 for c in correlations)])
        variance = ((1 - square) ** 2).sum() / freedom
        # The diagonal is one by definition.
        shrunk = float(min(1.0, variance / max(square.sum() - q, 1e-300)))
        blocks, log_volume = [], float(np.log(deviation).sum())
        for members, correlation in zip(rows, correlations, strict=True):
            correlation *= 1 - shrunk
            np.fill_diagonal(correlation, 1.0)
            factor = np.linalg.cholesky(correlation)
            (invert,) = get_lapack_funcs(("trtri",), (factor,))
            log_volume += float(np.log(np.diag(factor)).sum())
            blocks.append((members, invert(factor, lower=1)[0]))
        # Correlations that are shrunk are known the better.
        free = [1 + (len(r) - 1) * (1 - shrunk) ** 2 for r in rows]
        precision = max((freedom - max(free) - 1) / freedom, 0.2)
        freedoms = tuple(max(freedom - n + 1, 3.0) for n in free)
        return ResidualCovariance(
            deviation, tuple(blocks), freedom, freedoms, precision, log_volume
        )

    def whiten(self, rows: Array) -> Array:
        r"""Return :math:`L^{-1}` times each row, shape (n, q)."""
        white = np.empty_like(rows)
        for members, inverse in self.blocks:
            scaled = rows[:, members] / self.deviation[members]
            white[:, members] = scaled @ inverse.T
        return white


def alike(standardized: Array, freedom: int) -> float:
    r"""Return how many outcomes vary as one, :math:`\sum_{ij} r_{ij}^2 / q`.

    Less what chance adds to it, of residuals over their deviations, shape (n, q).
    """
    n, q = standardized.shape
    # Both products have the same sum of squares.
    product = standardized @ standardized.T if n < q else standardized.T @ standardized
    square = (product**2).sum() / freedom**2 - q * (q - 1) / freedom
    return float(max(square / max(q, 1), 1.0))


@dataclass(frozen=True, kw_only=True)
class ShapeSettings:
    """When and how residuals are taken for a mixture.

    Attributes:
        gain: Nats a number by which left-out residuals must be likelier than under a
            Gaussian. Half is what a few hundred Gaussian residuals lose by chance;
            twice leaves a Student t of ten degrees of freedom Gaussian.
        num_components: Components of the mixture. With two, beliefs under skewed noise
            are .058 nats off at 3,000 histories and .17 at 500, with three .048 and
            .14, with four .045 and .13.
        most_fitted: Residuals that the mixture is fitted to.
        floor: Size of the prediction, in its root mean square, below which the noise
            does not shrink: half lets the noise vanish where a mean crosses zero.
        powers: Least and largest power of the prediction.
    """

    gain: float = 0.01
    num_components: int = 4
    most_fitted: int = 3_000
    floor: float = 0.2
    powers: tuple[float, float] = (-0.5, 2.0)


@dataclass(frozen=True)
class Growth:
    r"""How the size of residuals grows with what they are on.

    Attributes:
        power: :math:`\beta`.
        floor: f, shape (q,).
        gain: Nats a number by which residuals are likelier than of one size.
        change: Deviation of the log variance over the simulations.
    """

    power: float
    floor: Array
    gain: float
    change: float

    @staticmethod
    def fit(mean: Array, residual: Array, own: ShapeSettings) -> Growth:
        """Return the growth of residuals on means, both (n, q), none constant.

        Args:
            mean: Predicted outcomes.
            residual: Outcomes less predictions.
            own: Settings.
        """
        floor = own.floor * np.sqrt((mean**2).mean(0)) + 1e-30
        log_mean = 0.5 * np.log(mean**2 + floor**2)

        def loss(power: float) -> float:
            """Return minus the Gaussian log likelihood but for a constant."""
            log_size = power * log_mean
            deviation = (residual / np.exp(log_size)).std(0)
            return float((np.log(deviation) + log_size.mean(0)).mean())

        found: Any = minimize_scalar(loss, bounds=own.powers, method="bounded")
        power = float(found.x)
        change = 2 * abs(power) * float(log_mean.std(0).mean())
        return Growth(power, floor, loss(0.0) - float(found.fun), change)

    def uneven(self, num: int, *, sure: float = 6.0, matters: float = 0.5) -> float:
        """Return how much it changes, above 1 where that matters and is no chance.

        Args:
            num: Number of residuals.
            sure: Nats of all of these that are no chance: 3.5 standard errors.
            matters: Deviation of the log variance that moves a belief.
        """
        return min(self.gain * num / sure, self.change / matters)


@dataclass(frozen=True)
class NoiseShape:
    r"""A density of residuals beside the Gaussian.

    Attributes:
        power: :math:`\beta`.
        floor: f, shape (q,).
        scale: c, shape (q,).
        mixture: F.
        covariance: Covariance of the normal scores y.
        shift: Mean of the scores, shape (q,).
        coefficient: Coefficients of outcomes less the observed ones, shape (p, q).
        observed: Observed outcomes, shape (q,).
    """

    power: float
    floor: Array
    scale: Array
    mixture: StudentMixture
    covariance: ResidualCovariance
    shift: Array
    coefficient: Array
    observed: Array

    @staticmethod
    def fit(
        features: Array,
        coefficient: Array,
        residual: Array,
        observed: Array,
        trial: NDArray[np.intp],
        own: ShapeSettings,
    ) -> NoiseShape | None:
        """Return the density; None where a Gaussian is as good.

        Args:
            features: Features of the simulations, shape (n, p).
            coefficient: Coefficients of outcomes less the observed ones, shape (p, q).
            residual: Outcomes less predictions, shape (n, q).
            observed: Observed outcomes, shape (q,).
            trial: Trial of each number, shape (q,).
            own: Settings.
        """
        n, q = residual.shape
        freedom = n - len(coefficient)
        mean = features @ coefficient + observed
        varies = residual.std(0) > 0
        if not varies.all() or q == 0:
            return None
        growth = Growth.fit(mean, residual, own)
        floor, power, gain = growth.floor, 0.0, 0.0
        if growth.gain > own.gain:
            power, gain = growth.power, growth.gain
        if power:  # least squares that weigh by the noise
            weight = (mean**2 + floor**2) ** -power
            normal = np.einsum("np,nj,nr->jpr", features, weight, features)
            score = np.einsum("np,nj->jp", features, weight * residual)
            step = np.linalg.solve(normal, score[..., None])[..., 0].T
            coefficient = coefficient + step
            residual, mean = residual - features @ step, mean + features @ step
        size = (mean**2 + floor**2) ** (0.5 * power)
        scale = np.sqrt(((residual / size) ** 2).sum(0) / freedom)
        e = residual / (size * scale)
        rng = np.random.default_rng(0)
        order = rng.permutation(n)
        halves = [e[order[: n // 2]].ravel(), e[order[n // 2 :]].ravel()]
        for here, there in (halves, halves[::-1]):
            mixture = _mixture(here, own, rng)
            normal = -0.5 * there**2 - 0.5 * np.log(2 * np.pi)
            gain += 0.5 * float((mixture.log_prob(there[:, None]) - normal).mean())
        if gain < own.gain:
            return None
        mixture = _mixture(e.ravel(), own, rng)
        score = _normal_scores(mixture, e)
        shift, deviation = score.mean(0), score.std(0)
        score = (score - shift) / deviation
        covariance = ResidualCovariance.of(score, deviation, freedom, trial)
        return NoiseShape(
            *(power, floor, scale, mixture, covariance, shift), *(coefficient, observed)
        )

    def log_likelihood(self, features: Array, widening: Array) -> Array:
        """Return log likelihoods of the observed outcomes, (n,).

        Args:
            features: Features of parameters, shape (n, p).
            widening: Factor of the variance for want of simulations, shape (n,).
        """
        error = features @ self.coefficient
        size = ((error + self.observed) ** 2 + self.floor**2) ** (0.5 * self.power)
        size = self.scale * size * np.sqrt(widening)[:, None]
        e = -error / size
        density = self.mixture.log_prob(e.reshape(-1, 1)).reshape(e.shape)
        score = _normal_scores(self.mixture, e)
        white = self.covariance.whiten(score - self.shift)
        marginal = (density + 0.5 * score**2 - np.log(size)).sum(1)
        return marginal - 0.5 * (white**2).sum(1) - self.covariance.log_volume


def _mixture(e: Array, own: ShapeSettings, rng: np.random.Generator) -> StudentMixture:
    some = rng.permutation(e)[: own.most_fitted, None]
    return fitted_normals(some, own.num_components, rng, num_iterations=100)


def _normal_scores(mixture: StudentMixture, e: Array) -> Array:
    """Return normal scores of residuals, of their shape."""
    parts = zip(mixture.weights, mixture.means, mixture.factors, strict=True)
    level = sum(w * ndtr((e - m[0]) / s[0, 0]) for w, m, s in parts)
    return ndtri(np.clip(level, 1e-12, 1 - 1e-12))

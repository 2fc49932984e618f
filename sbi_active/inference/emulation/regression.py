r"""Regressions of the outcomes of trials that share their simulations, near a belief.

The numbers of a trial are modeled as

.. math::
    x \mid \theta \sim t_\nu\big(B^\top f(u),\; (1 + h(u))\, S\big), \qquad
    h(u) = f(u)^\top (F^\top F)^{-1} f(u),

with f a basis in coordinates u (:mod:`.solving`), S the covariance of the residuals,
which holds the noise and what f misses, and h the leverage, by which the likelihood
widens where simulations are few.

References:
    Wood, Nature 2010 (synthetic likelihood).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2, f

from sbi_active.arrays import Array
from sbi_active.inference.emulation.residuals import (
    Growth,
    NoiseShape,
    ShapeSettings,
    alike,
)
from sbi_active.inference.emulation.solving import Basis, Region, best_solved, bulk
from sbi_active.inference.sampling.mixtures import log_student


@dataclass(frozen=True)
class Block:
    r"""The numbers of one trial, whitened.

    Attributes:
        white: Map of numbers less the observed ones to white ones, shape (q, q).
        coefficient: Coefficients of these, shape (p, q).
        freedom: Degrees of freedom of their density.
        share: Factor of the variance of a density of so few.
    """

    white: Array
    coefficient: Array
    freedom: float
    share: float

    def log_likelihood(self, rows: Array, widening: Array) -> Array:
        """Return log likelihoods of features (n, p), wider by factors (n,)."""
        wider, size = self.share * widening, len(self.white)
        square = ((rows @ self.compact) ** 2).sum(1) / wider
        log_volume = 0.5 * size * np.log(wider) - np.linalg.slogdet(self.white)[1]
        return log_student(square, log_volume, size, self.freedom)

    @cached_property
    def compact(self) -> Array:
        """Fewest numbers whose squares add up to those of the white ones, (p, k).

        An orthogonal map of these, many of which are linear in others where there are
        more numbers than features.
        """
        own = self.coefficient
        return own if own.shape[1] <= len(own) else np.linalg.qr(own.T)[1].T


@dataclass(frozen=True)
class Regression:
    r"""Regression of the numbers, less the observed ones, of trials with the same rows.

    Attributes:
        basis: f.
        root: :math:`R^{-1}` of F = Q R, so that h = |f R^{-1}|^2, shape (p, p).
        blocks: Numbers of each trial.
        precision: Factor that makes the inverse of the sample covariance unbiased.
        freedom: Degrees of freedom of the residuals.
        roughness: Share of the variance of some number that a polynomial misses.
        ratio: Residual over noise variance, mean over numbers.
        excess: This ratio with chance removed, and more of many numbers, whose misfit
            adds up: above 1 means misfit.
        standardized: Residuals near the belief over their deviations, shape (m, q).
        largest: Largest sum of their squares, whitened.
        shape: Another density of the noise, not Gaussian; None where that is none.
        uneven: Change of the log variance of the residuals by a deviation of a
            coordinate, or with what they are on, in units of what moves a belief, or of
            chance.
    """

    basis: Basis
    root: Array
    blocks: tuple[Block, ...]
    precision: float
    freedom: int
    roughness: float
    ratio: float
    excess: float
    standardized: Array
    largest: float
    shape: NoiseShape | None = None
    uneven: float = 0.0

    def __getstate__(self) -> dict[str, Any]:
        # Residuals have served the diagnostics and would only weigh on a pickle.
        return {**vars(self), "standardized": self.standardized[:0]}

    @property
    def has_misfit(self) -> bool:
        """Whether the residuals are larger than the noise."""
        return is_misfit(self.excess)

    @staticmethod
    def fit(
        region: Region,
        z: Array,
        x: Array,
        pairs: NDArray[np.intp],
        trial: NDArray[np.intp],
        observed: Array,
        *,
        shapes: ShapeSettings | None = None,
        fewest_pairs: int = 5,
        num_pairs: int = 20,
    ) -> Regression:
        """Return the regression.

        Args:
            region: Region of the belief.
            z: Coordinates of simulations, shape (n, d).
            x: Outcomes less the observed ones, shape (n, q).
            pairs: Rows of the same parameters, shape (r, 2).
            trial: Trial of each number, shape (q,).
            observed: Observed numbers, shape (q,), for a noise that grows with them.
            shapes: Settings of noise that is not Gaussian; None takes it for Gaussian.
            fewest_pairs: Pairs below which the noise is not told from misfit.
            num_pairs: Pairs at least that tell the noise, the nearest ones.
        """
        apart = region.distance(z[pairs[:, 0]])
        closest = np.sort(apart)[:num_pairs].max(initial=bulk(z.shape[1]))
        pairs = pairs[(apart <= closest) | np.isinf(region.reach)]
        rounding = float(np.finfo(np.float32).eps) * np.abs(x + observed).max(0)

        noise = np.full(x.shape[1], np.inf)
        if len(pairs) >= fewest_pairs:
            gap = x[pairs[:, 0]] - x[pairs[:, 1]]
            noise = 0.5 * (gap**2).mean(0) + rounding**2 + 1e-300
        own, polynomial = best_solved(region, z, x, noise)
        roughness = 0.0
        if np.isfinite(noise).all():
            share = (polynomial.square - noise) / np.maximum(x.var(0), noise)
            roughness = float(share.max(initial=0.0))
        shape, even, grows = None, own.residual, 0.0
        rows = region.distance(z) <= own.basis.reach
        f = own.basis(z[rows])
        rest = x[rows] - f @ own.coefficient
        varies = rest.std(0) > 0
        if shapes is not None:
            shape = NoiseShape.fit(f, own.coefficient, rest, observed, trial, shapes)
        elif varies.any():
            mean = (f @ own.coefficient + observed)[:, varies]
            growth = Growth.fit(mean, rest[:, varies], ShapeSettings())
            grows = growth.uneven(mean.size)
        if shape is not None:  # which knows of noise that grows with what it is on
            mean = f @ shape.coefficient
            size = ((mean + observed) ** 2 + shape.floor**2) ** (0.5 * shape.power)
            even = (x[rows] - mean) / size
        covariance, standardized = own.covariance(trial, noise)
        blocks = [
            Block(
                white=white,
                coefficient=own.coefficient[:, members] @ white,
                freedom=freedom,
                share=covariance.freedom / freedom,
            )
            for (members, white), freedom in zip(
                covariance.maps, covariance.freedoms, strict=True
            )
        ]
        ratio, left = own.square / noise, own.freedom(int(own.near.sum()))
        white = covariance.whiten(own.residual[own.near])
        return Regression(
            basis=own.basis,
            root=own.root,
            blocks=tuple(blocks),
            precision=covariance.precision,
            freedom=covariance.freedom,
            roughness=roughness,
            ratio=float(ratio.mean()) if np.isfinite(noise).any() else 1.0,
            excess=_excess(
                ratio, alike(standardized, covariance.freedom), left, len(pairs)
            ),
            standardized=standardized,
            largest=float((white**2).sum(1).max() / chi2.ppf(0.9, white.shape[1])),
            shape=shape,
            uneven=max(grows, _uneven(z[rows][own.near], even[own.near])),
        )

    def residual(self, z: Array, place: int) -> tuple[Array, Array]:
        """Return the whitened prediction less the observed, and its variance.

        The variance counts the noise as 1; of shapes (n, q) and (n, 1).

        Args:
            z: Coordinates, shape (n, d).
            place: Place of a trial among those of the regression.
        """
        rows = self.basis(z)
        leverage = ((rows @ self.root) ** 2).sum(1, keepdims=True)
        return rows @ self.blocks[place].coefficient, 1 + leverage

    def whitened_outcomes(self, x: Array, place: int) -> Array:
        """Return numbers of a trial less the observed ones, whitened, shape (n, q)."""
        return x @ self.blocks[place].white

    def draw(self, z: Array, rng: np.random.Generator) -> Array:
        """Return whitened numbers at parameters (n, d) less the observed, (n, q)."""
        mean, spread = self.residual(z, 0)
        return mean + np.sqrt(spread) * rng.standard_normal(mean.shape)

    def caution(self, *, least: float = 2.0) -> float:
        """Factor of the variance that keeps what the misfit would wrongly exclude.

        Misfit is no noise: it is the same at each visit, and where the posterior lies
        it may be as large as anywhere in the region. So the largest residual shall
        count as an ordinary one, and misfit for a factor of 2 at least (a choice).
        """
        return max(least, self.largest) if self.has_misfit else 1.0

    def log_likelihood(self, z: Array, caution: float = 1.0) -> Array:
        """Return the log likelihood of the observation, (n, d) -> (n,)."""
        rows = self.basis(z)
        widening = caution * (1 + ((rows @ self.root) ** 2).sum(1))
        each = [block.log_likelihood(rows, widening) for block in self.blocks]
        total = np.sum(each, axis=0)
        if self.shape is not None:
            total = 0.5 * (total + self.shape.log_likelihood(rows, widening))
        return total

    def error(
        self,
        z: Array,
        rng: np.random.Generator,
        *,
        explained: bool = False,
        num_places: int = 400,
        num_repeats: int = 20,
    ) -> float:
        r"""Return the expected divergence from the belief of endless simulations, nats.

        A coefficient has the error :math:`E \sim \mathcal N(0, (F^\top F)^{-1} \otimes
        S)`, so that a log likelihood is off by some :math:`\delta(z)`, and the belief,
        to second order, by

        .. math::
            \mathrm{KL} \approx \tfrac12\, \mathrm{Var}_{z \sim b}\big(\delta(z)\big) .

        Args:
            z: Draws of the belief, shape (n, d).
            rng: Source of the errors.
            explained: Whether observations that lie further out than simulations are
                moved to where those lie, so that the error is of simulations alone.
            num_places: Number of draws that are looked at (a choice).
            num_repeats: Number of repeated coefficients (a choice).
        """
        rows = self.basis(z[:: max(len(z) // num_places, 1)])
        coefficient = np.concatenate([b.coefficient for b in self.blocks], 1)
        rotated, error, (p, q) = rows @ self.root, rows @ coefficient, coefficient.shape
        widening = 1 + (rotated**2).sum(1)
        if explained:
            usual = np.sqrt(q * widening / self.precision)
            length = np.linalg.norm(error, axis=1)
            error *= (usual / np.maximum(length, usual))[:, None]
        changes = []
        for _ in range(num_repeats):
            step = rotated @ rng.standard_normal((p, q))
            variance = rng.standard_normal(q) * (2 / self.freedom) ** 0.5
            square = (step * (step + 2 * error)).sum(1) + error**2 @ variance
            changes.append(-0.5 * self.precision / widening * square)
        return 0.5 * float(np.stack(changes).var(1).mean())


def fewest_rows(dim: int, *, freedom: int = 20) -> int:
    """Return the rows that a linear regression on so many parameters takes."""
    return 1 + dim + freedom


def is_misfit(excess: float, *, most: float = 1.12) -> bool:
    """Return whether a basis misses something, by residual over noise variance."""
    return excess > most


def _uneven(
    z: Array, residual: Array, *, sure: float = 3.5, matters: float = 0.5
) -> float:
    r"""Return how much the variance of residuals changes along the parameters.

    The logarithm of their squares is regressed on the coordinates.

    Args:
        z: Coordinates of simulations, shape (n, d).
        residual: Their residuals, shape (n, q).
        sure: Standard errors of a slope that are no chance.
        matters: Slope that moves a belief: the noise changes by 28 % over a deviation.
    """
    n, d = z.shape
    varies = residual.std(0) > 0
    if n < 4 * (d + 1) or not varies.any() or not (z.std(0) > 0).all():
        return 0.0
    scaled = residual[:, varies] / residual[:, varies].std(0)
    y = np.log((scaled**2).mean(1) + 1e-12)
    f = np.column_stack([np.ones(n), (z - z.mean(0)) / z.std(0)])
    slope, *_ = np.linalg.lstsq(f, y, rcond=None)
    rest = ((y - f @ slope) ** 2).sum() / (n - d - 1)
    error = np.sqrt(rest * np.diag(np.linalg.pinv(f.T @ f)))
    return float((np.abs(slope) / np.maximum(matters, sure * error))[1:].max())


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
    squares of the residuals' correlations. With more than ``numbers``, a smaller misfit
    of each is as bad, since smooth misfits add up: 3 % of the variance of
    1,000 numbers moved a mean by .8 deviations. At 20 the largest shift of four seeds
    is .25, at 10 .44 and at 40 .20.
    """
    q = len(ratio)
    deviation = np.sqrt(2 / freedom + 2 / max(num_pairs, 1))
    mean = ratio.mean() - 3 * deviation * np.sqrt(num_alike / q)
    mean = 1 + (mean - 1) * max(1.0, q / numbers)
    largest = ratio.max() / f.isf(chance / q, freedom, max(num_pairs, 1))
    return float(max(mean, largest))

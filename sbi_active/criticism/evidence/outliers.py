r"""One trial with a gross error: a slip of the hand, of the unit, of the record.

.. math::
    p(r) = \frac1t \sum_{k=1}^t p_k(r_k) \prod_{j \ne k} p(r_j),

with the declared noise p of every trial but one, equally likely any of them. That one
errs by more, to an unknown degree a: the whole trial scatters a times as widely. It
takes the values 3, 9, 27, ... with probabilities in proportion to :math:`1 / i^2`, so
that the density falls with the size of the error and ends nowhere.

References:
    Box & Tiao, Biometrika 55 (1968), 119-129: a Bayesian approach to outliers.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from sbi_active.criticism.data.measurements import Measurements
from sbi_active.criticism.rivals.error_models import (
    LOG_2PI,
    ErrorModel,
    NoiseCell,
    NoiseGrid,
    Whitener,
    drawn,
    student,
)
from sbi_active.inference.sampling.weights import log_sum_exp

Array = NDArray[Any]

#: Ratio of neighboring sizes of a gross error, the smallest among them, and the number
#: that any set of trials has.
RATIO, FEWEST_SIZES = 3.0, 5
#: Size that stands for any in a search, and trials that a search sets aside in turn.
LARGE, MAX_ASIDE = 1e3, 8


class OneOutlier(ErrorModel):
    """The noise, with a gross error in one trial, whichever it is.

    Args:
        noise: The error of all other trials.
        measurements: Measurements that the residuals belong to.
        largest: Size that an error may need to have, in standard deviations.

    Attributes:
        trials: Trials with a measurement, shape (k,).
        sizes: Sizes of the gross error, in standard deviations of the noise, shape
            (s,).
    """

    def __init__(
        self, noise: NoiseGrid, measurements: Measurements, *, largest: float
    ) -> None:
        self.noise, self.measurements = noise, measurements
        self.trials = np.unique(measurements.trial)
        self._member = measurements.trial[:, None] == self.trials  # (N, k)
        needed = np.log(max(largest, 1.0)) / np.log(RATIO)
        steps = 1 + np.arange(max(int(np.ceil(needed)), FEWEST_SIZES))
        self.sizes = RATIO**steps
        self._log_size = np.log(6 / np.pi**2) - 2 * np.log(steps)

    @override
    def log_likelihood(self, residual: Array) -> Array:
        return log_sum_exp(self._joint(residual).reshape(len(residual), -1), axis=1)

    def responsibility(self, residual: Array) -> Array:
        """Return the probability that each trial is the one, shape (n, k)."""
        rows = np.moveaxis(self._joint(residual), 2, 1).reshape(
            len(residual), len(self.trials), -1
        )
        each = log_sum_exp(rows, axis=2)
        return np.exp(each - log_sum_exp(each, axis=1)[:, None])

    def without_each(self, residual: Array) -> Array:
        """Return log densities of all trials but each one, shape (n, k).

        Args:
            residual: Residuals, shape (n, N).
        """
        parts = []
        for cell, prior in zip(self.noise.cells, self.noise.log_prior, strict=True):
            usual = self._density(cell.whiten(residual), cell, self.noise.scales)
            others = usual @ (1 - np.eye(len(self.trials)))
            own = np.log(cell.sd) + 0.5 * np.log1p(-(cell.rho**2))
            scale = own.sum() - own @ self._member
            weight = prior + self.noise.log_scale_prior[:, None]
            parts.append(log_sum_exp(others + weight, axis=1) - scale)
        return log_sum_exp(np.stack(parts), axis=0)

    @override
    def noise_posterior(
        self, residual: Array, rng: np.random.Generator
    ) -> tuple[NDArray[np.intp], Array]:
        joint = np.moveaxis(self._joint(residual), 2, 3)  # (n, cells, scales, ...)
        log_p = log_sum_exp(joint.reshape(*joint.shape[:3], -1), axis=3)
        cell, scale = drawn(log_p, rng)
        return cell, self.noise.sizes(self.noise.scales[scale])

    @override
    def start(self) -> Whitener:
        return self.noise.start()

    @override
    def whitener(self, residual: Array) -> Whitener:
        joint = self._joint(residual[None])[0]
        best = np.unravel_index(np.argmax(joint), joint.shape)
        cell, trial, scale, size = map(int, best)
        return self._whitener(cell, trial, scale, self.sizes[size])

    @override
    def regimes(self, residual: Array) -> list[Whitener]:
        # Without one trial the parameters may be elsewhere, and are less certain.
        share = self.responsibility(residual[None])[0]
        cell = int(np.argmax(self.noise.log_prior))
        scale = len(self.noise.scales) // 2
        return [
            self._whitener(cell, int(trial), scale, LARGE)
            for trial in np.argsort(-share, kind="stable")[:MAX_ASIDE]
        ]

    def _whitener(self, cell: int, trial: int, scale: int, size: float) -> Whitener:
        noise, unit = self.noise.cells[cell], self.noise.scales[scale]
        divisor = unit * np.where(self._member[:, trial], size, 1.0)
        return lambda residual: noise.whiten(residual) / divisor

    def _joint(self, residual: Array) -> Array:
        """Return log p(residual, cell, trial, ...), shape (n, cells, k, ...)."""
        cells = range(len(self.noise.cells))
        return np.stack([self._within(residual, c) for c in cells], 1)

    def _within(self, residual: Array, c: int) -> Array:
        """Return log p(residual, trial, scale, size) in a cell, (n, k, ...)."""
        cell, scales = self.noise.cells[c], self.noise.scales
        e = cell.whiten(residual)
        usual = self._density(e, cell, scales)
        others = usual @ (1 - np.eye(len(self.trials)))  # (n, scales, k)
        wide = np.multiply.outer(scales, self.sizes)
        as_wide = self._density(e, cell, wide.ravel())
        as_wide = as_wide.reshape(len(e), *wide.shape, -1)
        prior = self.noise.log_prior[c] - cell.log_scale - np.log(len(self.trials))
        prior = prior + self._log_size[:, None]
        joint = others[:, :, None] + as_wide + prior  # (n, scales, sizes, k)
        joint = joint + self.noise.log_scale_prior[:, None, None]
        return np.moveaxis(joint, -1, 1)

    def _density(self, e: Array, cell: NoiseCell, scales: Array) -> Array:
        """Return log densities of each trial's numbers by scale, (n, scales, k)."""
        member, num = self._member.astype(float), self._member.sum(0)
        if np.isfinite(cell.df):
            log_p = student(e[:, None] / scales[:, None], cell.df) @ member
        else:
            square = (e**2 @ member)[:, None]
            log_p = -0.5 * square / scales[:, None] ** 2 - 0.5 * num * LOG_2PI
        return log_p - num * np.log(scales)[:, None]

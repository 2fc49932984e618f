r"""Noise whose size is unknown in each channel by itself.

Given the parameters and the correlation time, channels are independent, and the sum
over the sizes is one over each channel in turn,

.. math::
    p(r) = \sum_\tau w_\tau \prod_c \sum_s w_{cs}\, p(r_c \mid \tau, s\, \sigma_c),

and no combination of sizes is looked at by itself. What has further unknowns that all
channels share (a gross error in one trial, a smooth function of the action) takes the
ratio of the sizes from the bare model's best fit, and sums over their common factor.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from sbi_active.criticism.rivals.error_models import (
    LOG_2PI,
    Array,
    NoiseCell,
    NoiseGrid,
    Whitener,
    drawn,
)
from sbi_active.inference.sampling.weights import log_sum_exp

__all__ = ["ChannelNoise", "SettledNoise"]


class ChannelNoise(NoiseGrid):
    """Gaussian noise with an unknown size in each channel.

    Args:
        cells: Cells of the correlation time; their sd is each channel's middle size.
        channel: Channel of each number, shape (N,).
        factors: Sizes of each channel in units of its middle one, shape (c, j).
        log_factor_prior: Log prior probabilities, shape (c, j).
        scales: Further factors, of all channels alike, shape (k,).
        log_weights: Log prior probabilities, shape (k,).
    """

    def __init__(
        self,
        cells: list[NoiseCell],
        *,
        channel: NDArray[np.int64],
        factors: Array,
        log_factor_prior: Array,
        scales: Array | None = None,
        log_weights: Array | None = None,
    ) -> None:
        super().__init__(cells, scales=scales, log_weights=log_weights)
        self.channel, self.factors, self.is_known = channel, factors, False
        total = log_sum_exp(log_factor_prior, axis=1)
        self.log_factor_prior = log_factor_prior - total[:, None]

    @override
    def joint(self, residual: Array) -> Array:
        parts = []
        for cell, prior in zip(self.cells, self.log_prior, strict=True):
            each = log_sum_exp(self._by_size(cell, residual), axis=3).sum(2)
            parts.append(prior + self.log_scale_prior + each - cell.log_scale)
        return np.stack(parts, 1)

    @override
    def start(self) -> Whitener:
        cell, scale = self._typical()
        return self._whitener(cell, np.full(len(self.factors), scale))

    @override
    def whitener(self, residual: Array) -> Whitener:
        cell, sizes = self.likeliest(residual)
        return self._whitener(self.cells[cell], sizes)

    def likeliest(self, residual: Array) -> tuple[int, Array]:
        """Return the cell and the sizes (c,) that a residual (N,) points to."""
        joint = self.joint(residual[None])[0]
        cell, scale = np.unravel_index(np.argmax(joint), joint.shape)
        by_size = self._by_size(self.cells[cell], residual[None])[0, scale]
        best = by_size.argmax(1)
        return int(cell), self.scales[scale] * self.factors[np.arange(len(best)), best]

    @override
    def noise_posterior(
        self, residual: Array, rng: np.random.Generator
    ) -> tuple[NDArray[np.intp], Array]:
        cells, scales = drawn(self.joint(residual), rng)
        sizes = np.empty((len(residual), len(self.factors)))
        for cell in np.unique(cells):
            own = np.flatnonzero(cells == cell)
            by_size = self._by_size(self.cells[cell], residual[own])
            at_scale = by_size[np.arange(len(own)), scales[own]]
            for c, factors in enumerate(self.factors):
                (picked,) = drawn(at_scale[:, c], rng)
                sizes[own, c] = self.scales[scales[own]] * factors[picked]
        return cells, sizes

    @override
    def by_number(self, sizes: Array) -> Array:
        return sizes[:, self.channel]

    @override
    def scaled(self, scales: Array, log_weights: Array) -> ChannelNoise:
        own = super().scaled(scales, log_weights)
        return self._like(self.cells, self.channel, own)

    @override
    def part(self, at: NDArray[np.bool_]) -> ChannelNoise:
        cells = [replace(c, sd=c.sd[at], rho=c.rho[at]) for c in self.cells]
        return self._like(cells, self.channel[at], self)

    @override
    def of_cells(self, cells: list[NoiseCell]) -> ChannelNoise:
        return self._like(cells, self.channel, self)

    @override
    def settled(self, residual: Callable[[], Array]) -> SettledNoise:
        return SettledNoise(self, residual())

    def _like(
        self, cells: list[NoiseCell], channel: NDArray[np.int64], common: NoiseGrid
    ) -> ChannelNoise:
        return ChannelNoise(
            cells,
            channel=channel,
            factors=self.factors,
            log_factor_prior=self.log_factor_prior,
            scales=common.scales,
            log_weights=common.log_scale_prior,
        )

    def _by_size(self, cell: NoiseCell, residual: Array) -> Array:
        """Return log p(residual of a channel, size | cell, scale), (n, k, c, j).

        Up to the log scale of the cell.
        """
        num_channels = len(self.factors)
        member = self.channel[:, None] == np.arange(num_channels)
        square, count = cell.whiten(residual) ** 2 @ member, member.sum(0)
        size = self.scales[:, None, None] * self.factors  # (k, c, j)
        log_p = -0.5 * square[:, None, :, None] / size**2
        log_p = log_p - count[:, None] * (np.log(size) + 0.5 * LOG_2PI)
        return log_p + self.log_factor_prior

    def _whitener(self, cell: NoiseCell, sizes: Array) -> Whitener:
        unit = sizes[self.channel]
        return lambda residual: cell.whiten(residual / unit)


class SettledNoise(NoiseGrid):
    """Noise of several channels with sizes whose ratio is given.

    It is as probable as the noise that it stands for where a residual is that by which
    the ratio was chosen, so that models with either can be compared.

    Args:
        noise: Noise that it stands for.
        residual: Residuals, shape (N,).
    """

    def __init__(
        self,
        noise: ChannelNoise,
        residual: Array,
        *,
        # Common factors of sizes whose ratio is given, and how far they reach.
        num_factors: int = 40,
        reach: float = 30.0,
    ) -> None:
        _, self.ratio = noise.likeliest(residual)
        unit = self.ratio[noise.channel]
        cells = [replace(cell, sd=cell.sd * unit) for cell in noise.cells]
        scales = np.geomspace(1 / reach, reach, num_factors)
        super().__init__(cells, scales=scales)
        one = residual[None]
        apart = noise.log_likelihood(one) - self.log_likelihood(one)
        self.log_prior = self.log_prior + apart[0]

    @override
    def sizes(self, scales: Array) -> Array:
        return scales[:, None] * self.ratio

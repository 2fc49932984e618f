r"""Distributions of the measurement error, with what is unknown summed out.

The correlation time and the size of the noise belong to the bare model and to every
rival alike. Each is a grid, so that a likelihood is a sum over its cells and no rival
pays for them with a coordinate.

Where the size is unknown in each channel by itself, channels are independent given the
parameters and the correlation time, and the sum over the sizes is one over each channel
in turn,

.. math::
    p(r) = \sum_\tau w_\tau \prod_c \sum_s w_{cs}\, p(r_c \mid \tau, s\, \sigma_c),

and no combination of sizes is looked at by itself. What has further unknowns that all
channels share (a gross error in one trial, a smooth function of the action) takes the
ratio of the sizes from the bare model's best fit, and sums over their common factor.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln

from sbi_active.arrays import Array
from sbi_active.criticism.data.measurements import Measurements
from sbi_active.inference.sampling.weights import log_sum_exp

Whitener = Callable[[Array], Array]

LOG_2PI = float(np.log(2 * np.pi))


@dataclass(frozen=True)
class NoiseCell:
    r"""Gaussian or Student-t noise with all its parameters known but for a scale.

    Along a trajectory, :math:`u_k = \rho_k u_{k-1} + \sqrt{1 - \rho_k^2}\, e_k` for
    :math:`u = r / s`, with :math:`\rho_k = e^{-\Delta t_k / \tau}`.

    Attributes:
        log_weight: Log prior probability.
        sd: s, shape (N,).
        rho: Correlation with the number before, 0 for the first, shape (N,).
        df: Degrees of freedom of t noise of standard deviation s; inf for Gaussian.
    """

    log_weight: float
    sd: Array
    rho: Array
    df: float = np.inf

    @classmethod
    def of(
        cls,
        measurements: Measurements,
        *,
        sd: Array,
        correlation_time: float = 0.0,
        df: float = np.inf,
        log_weight: float = 0.0,
    ) -> NoiseCell:
        """Return noise of some standard deviation, shape (N,), and correlation time."""
        rho = np.zeros(len(measurements))
        if correlation_time > 0:
            rho = np.exp(-measurements.gap / correlation_time)
        return cls(log_weight, sd, np.minimum(rho, 1 - 1e-9), df)

    def whiten(self, residual: Array) -> Array:
        """Return the innovations e, shape (..., N)."""
        u = residual / self.sd
        if not self.rho.any():
            return u
        before = np.zeros_like(u)
        before[..., 1:] = u[..., :-1]
        return (u - self.rho * before) / np.sqrt(1 - self.rho**2)

    @cached_property
    def log_scales(self) -> Array:
        """Log of what :meth:`whiten` divides each number by, shape (N,)."""
        return np.log(self.sd) + 0.5 * np.log1p(-(self.rho**2))

    @property
    def log_scale(self) -> float:
        """Log determinant of the inverse of :meth:`whiten`."""
        return float(self.log_scales.sum())

    def part(self, at: NDArray[np.bool_]) -> NoiseCell:
        """Return this noise of some of the numbers, shape (N,)."""
        return replace(self, sd=self.sd[at], rho=self.rho[at])


@dataclass(frozen=True)
class NoiseGrid:
    """Noise whose correlation and size are known up to a grid.

    Attributes:
        cells: Cells of the correlation time and the noise model's own parameters.
        scales: Factors on the standard deviation, shape (j,).
        log_weights: Log prior probabilities of these, shape (j,); None for equal ones.
        offset: Log probability that is added to all, of noise that stands for another.
        channel: Channel of each number, shape (N,), where each has a size of its own;
            None for one size.
        factors: Sizes of each channel in units of that of the cells, shape (c, s).
        log_factors: Log prior probabilities of these, shape (c, s).
        ratio: Sizes of the channels in those of the cells, shape (c,), where a
            prediction asks for those of each.
    """

    cells: Sequence[NoiseCell]
    scales: Array = field(default_factory=lambda: np.ones(1))
    log_weights: Array | None = None
    offset: float = 0.0
    channel: NDArray[np.int64] | None = None
    factors: Array = field(default_factory=lambda: np.ones((1, 1)))
    log_factors: Array = field(default_factory=lambda: np.zeros((1, 1)))
    ratio: Array = field(default_factory=lambda: np.ones(1))

    @cached_property
    def log_prior(self) -> Array:
        """Log prior probability of each cell."""
        weights = np.array([cell.log_weight for cell in self.cells])
        return weights - log_sum_exp(weights) + self.offset

    @cached_property
    def log_scale_prior(self) -> Array:
        """Log prior probability of each scale."""
        if self.log_weights is None:
            return np.full(len(self.scales), -np.log(len(self.scales)))
        return self.log_weights - log_sum_exp(self.log_weights)

    @property
    def is_known(self) -> bool:
        """Whether nothing of it is unknown, so that one transform whitens all."""
        return len(self.cells) == self.factors.size == len(self.scales) == 1

    @property
    def typical_sd(self) -> Array:
        """Geometric mean over the cells, shape (N,)."""
        return np.exp(np.mean([np.log(cell.sd) for cell in self.cells], 0))

    def log_likelihood(self, residual: Array) -> Array:
        """Return log densities, shape (n,), of residuals, shape (n, N)."""
        return log_sum_exp(self.joint(residual).reshape(len(residual), -1), axis=1)

    def joint(self, residual: Array) -> Array:
        """Return log p(residual, cell, scale), shape (n, cells, scales)."""
        parts = []
        for cell, prior in zip(self.cells, self.log_prior, strict=True):
            each = log_sum_exp(self._by_size(cell, residual), axis=3).sum(2)
            parts.append(prior + self.log_scale_prior + each - cell.log_scale)
        return np.stack(parts, 1)

    def posterior(self, residual: Array) -> Array:
        """Return the probability of cells and scales, shape (cells, scales)."""
        joint = self.joint(residual[None])[0]
        return np.exp(joint - log_sum_exp(joint))

    @cached_property
    def start(self) -> Whitener:
        """The whitening transform to start a least-squares search with."""
        middle = np.argsort(self.scales)[len(self.scales) // 2]
        sizes = np.full(len(self.factors), self.scales[middle])
        return self._whitener(int(np.argmax(self.log_prior)), sizes)

    def whitener(self, residual: Array) -> Whitener:
        """Return the whitening transform that a residual (N,) makes most probable.

        It maps (..., N) to (..., N), linearly.
        """
        return self._whitener(*self.likeliest(residual))

    def likeliest(self, residual: Array) -> tuple[int, Array]:
        """Return the cell and the sizes (c,) that a residual (N,) points to."""
        joint = self.joint(residual[None])[0]
        cell, scale = np.unravel_index(np.argmax(joint), joint.shape)
        by_size = self._by_size(self.cells[int(cell)], residual[None])[0, scale]
        best = by_size.argmax(1)
        return int(cell), self.scales[scale] * self.factors[np.arange(len(best)), best]

    def settled(self, residual: Array) -> NoiseGrid:
        """Return noise with sizes whose ratio is that which a residual (N,) points to.

        For that residual it is as probable as this one, so that models with either can
        be compared. Noise of one size is this one.
        """
        if self.channel is None:
            return self
        _, ratio = self.likeliest(residual)
        cells = [replace(c, sd=c.sd * ratio[self.channel]) for c in self.cells]
        new = NoiseGrid(cells, scales=np.geomspace(1 / 30, 30, 40), ratio=ratio)
        one = residual[None]
        apart = self.log_likelihood(one) - new.log_likelihood(one)
        return replace(new, offset=apart[0])

    def noise_posterior(
        self, residual: Array, rng: np.random.Generator
    ) -> tuple[NDArray[np.intp], Array]:
        """Return a cell and sizes of the noise for each residual, at random.

        Args:
            residual: Residuals, shape (n, N).
            rng: Source of the draws.

        Returns:
            Cells, shape (n,), and factors on their deviations by channel, shape (n, c).
        """
        cells, scales = drawn(self.joint(residual), rng)
        sizes = self.sizes(self.scales[scales])
        if self.channel is None:
            return cells, sizes
        sizes = np.repeat(sizes, len(self.factors), 1)
        for cell in np.unique(cells):
            own = np.flatnonzero(cells == cell)
            by_size = self._by_size(self.cells[cell], residual[own])
            at_scale = by_size[np.arange(len(own)), scales[own]]
            for c, factors in enumerate(self.factors):
                (picked,) = drawn(at_scale[:, c], rng)
                sizes[own, c] *= factors[picked]
        return cells, sizes

    def sizes(self, scales: Array) -> Array:
        """Return the sizes of the channels that scales (n,) stand for, (n, c)."""
        return scales[:, None] * self.ratio

    def by_number(self, sizes: Array) -> Array:
        """Return the size of each number, shape (n, N), from those of channels."""
        return sizes[:, self._groups]

    def errors(
        self, cells: Array, sizes: Array, rng: np.random.Generator
    ) -> tuple[Array, Array]:
        """Return errors at random, and their deviations, shape (n, N).

        Args:
            cells: Cell of each draw, shape (n,).
            sizes: Factors on the cell's deviations, shape (n, N).
            rng: Source of the errors.
        """
        own = [self.cells[cell] for cell in cells]
        rho, u = np.stack([cell.rho for cell in own]), rng.normal(size=sizes.shape)
        for row, cell in zip(u, own, strict=True):
            if np.isfinite(df := cell.df):
                row[:] = rng.standard_t(df, size=len(row)) * np.sqrt((df - 2) / df)
        for k in range(1, u.shape[1]) if rho.any() else ():
            step = np.sqrt(1 - rho[:, k] ** 2) * u[:, k]
            u[:, k] = rho[:, k] * u[:, k - 1] + step
        sd = np.stack([cell.sd for cell in own]) * sizes
        return u * sd, sd

    def log_density(self, cells: Array, sizes: Array, residual: Array) -> Array:
        """Return log densities of residuals (n, N), each in its cell, shape (n,)."""
        log_p, u = np.empty(len(residual)), residual / sizes
        for cell in np.unique(cells):
            own, alone = cells == cell, replace(self.cells[cell], log_weight=0.0)
            log_p[own] = NoiseGrid([alone]).log_likelihood(u[own])
        return log_p - np.log(sizes).sum(1)

    def scaled(self, scales: Array, log_weights: Array) -> NoiseGrid:
        """Return this noise with further factors on its standard deviation."""
        product = np.multiply.outer(self.scales, scales).ravel()
        weight = np.add.outer(self.log_scale_prior, log_weights).ravel()
        return replace(self, scales=product, log_weights=weight)

    def with_extra(self, sd: Array) -> NoiseGrid:
        """Return this noise with an independent error of deviation sd, shape (N,)."""
        cells = [replace(cell, sd=np.hypot(cell.sd, sd)) for cell in self.cells]
        return replace(self, cells=cells)

    def part(self, at: NDArray[np.bool_]) -> NoiseGrid:
        """Return this noise of some of the numbers, shape (N,)."""
        channel = None if self.channel is None else self.channel[at]
        return replace(self, cells=[c.part(at) for c in self.cells], channel=channel)

    @property
    def _groups(self) -> NDArray[np.int64]:
        """Channel of each number among those with sizes of their own, shape (N,)."""
        if self.channel is None:
            return np.zeros(len(self.cells[0].sd), dtype=np.int64)
        return self.channel

    def _whitener(self, cell: int, sizes: Array) -> Whitener:
        own, unit = self.cells[cell], sizes[self._groups]
        return lambda residual: own.whiten(residual) / unit

    def _by_size(self, cell: NoiseCell, residual: Array) -> Array:
        """Return log p(residual of a channel, size | cell, scale), (n, j, c, s).

        Up to the log scale of the cell.
        """
        member = self._groups[:, None] == np.arange(len(self.factors))
        e, count = cell.whiten(residual), member.sum(0)[:, None]
        size = self.scales[:, None, None] * self.factors
        if np.isinf(cell.df):
            log_p = -0.5 * (e**2 @ member)[:, None, :, None] / size**2
            log_p = log_p - 0.5 * count * LOG_2PI
        else:
            each = student(e[:, None, :, None] / size[:, self._groups], cell.df)
            log_p = np.einsum("njis,ic->njcs", each, member)
        total = log_sum_exp(self.log_factors, axis=1)[:, None]
        return log_p - count * np.log(size) + (self.log_factors - total)


def drawn(log_p: Array, rng: np.random.Generator) -> tuple[NDArray[np.intp], ...]:
    """Return a place (n,) in each axis of unnormalized log densities (n, ...)."""
    flat = log_p.reshape(len(log_p), -1)
    best = np.argmax(flat + rng.gumbel(size=flat.shape), axis=1)  # of softmax
    return np.unravel_index(best, log_p.shape[1:])


def student(e: Array, df: float) -> Array:
    """Return log densities of t errors of unit standard deviation."""
    log_norm = gammaln(0.5 * (df + 1)) - gammaln(0.5 * df)
    log_norm -= 0.5 * np.log(np.pi * (df - 2))
    return log_norm - 0.5 * (df + 1) * np.log1p(e**2 / (df - 2))

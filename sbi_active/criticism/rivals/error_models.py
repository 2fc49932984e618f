"""Distributions of the measurement error, with what is unknown summed out.

The correlation time and the size of the noise belong to the bare model and to every
rival alike. Each is a grid, so that a likelihood is a sum over its cells and no rival
pays for them with a coordinate.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln
from typing_extensions import override

from sbi_active.arrays import Array
from sbi_active.criticism.data.measurements import Measurements
from sbi_active.inference.sampling.weights import log_sum_exp

Whitener = Callable[[Array], Array]

LOG_2PI = float(np.log(2 * np.pi))


class ErrorModel(ABC):
    """Density of the residual, observation minus noise-free output.

    Attributes:
        is_known: Whether nothing of it is unknown, so that one transform whitens all.
    """

    is_known = False

    @abstractmethod
    def log_likelihood(self, residual: Array) -> Array:
        """Return log densities, shape (n,), of residuals, shape (n, N)."""

    @abstractmethod
    def start(self) -> Whitener:
        """Return the whitening transform to start a least-squares search with."""

    @abstractmethod
    def whitener(self, residual: Array) -> Whitener:
        """Return the whitening transform that a residual (N,) makes most probable.

        It maps (..., N) to (..., N), linearly.
        """

    @abstractmethod
    def noise_posterior(
        self, residual: Array, rng: np.random.Generator
    ) -> tuple[NDArray[np.intp], Array]:
        """Return a cell and a size of the noise for each residual, at random.

        Args:
            residual: Residuals, shape (n, N).
            rng: Source of the draws.

        Returns:
            Cells, shape (n,), and factors on their deviations, shape (n,), or (n, c)
            where each channel has its own.
        """


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
        if correlation_time > 0:
            rho = np.exp(-measurements.gap / correlation_time)
        else:
            rho = np.zeros(len(measurements))
        return cls(log_weight, sd, np.minimum(rho, 1 - 1e-9), df)

    def whiten(self, residual: Array) -> Array:
        """Return the innovations e, shape (..., N)."""
        u = residual / self.sd
        if not self.rho.any():
            return u
        before = np.zeros_like(u)
        before[..., 1:] = u[..., :-1]
        return (u - self.rho * before) / np.sqrt(1 - self.rho**2)

    @property
    def log_scale(self) -> float:
        """Log determinant of the inverse of :meth:`whiten`."""
        return float(np.log(self.sd).sum() + 0.5 * np.log1p(-(self.rho**2)).sum())


class NoiseGrid(ErrorModel):
    """Noise whose correlation and size are known up to a grid.

    Args:
        cells: Cells of the correlation time and the noise model's own parameters.
        scales: Factors on the standard deviation, shape (j,).
        log_weights: Log prior probabilities, shape (j,).
    """

    def __init__(
        self,
        cells: list[NoiseCell],
        *,
        scales: Array | None = None,
        log_weights: Array | None = None,
    ) -> None:
        total = log_sum_exp(np.array([cell.log_weight for cell in cells]))
        self.cells = cells
        self.log_prior = np.array([cell.log_weight - total for cell in cells])
        self.scales = np.ones(1) if scales is None else scales
        self.is_known = len(cells) == len(self.scales) == 1
        self.log_scale_prior = (
            np.full(len(self.scales), -np.log(len(self.scales)))
            if log_weights is None
            else log_weights - log_sum_exp(log_weights)
        )

    @override
    def log_likelihood(self, residual: Array) -> Array:
        return log_sum_exp(self.joint(residual).reshape(len(residual), -1), axis=1)

    def joint(self, residual: Array) -> Array:
        """Return log p(residual, cell, scale), shape (n, cells, scales)."""
        num = residual.shape[1]
        parts = []
        for cell, prior in zip(self.cells, self.log_prior, strict=True):
            e = cell.whiten(residual)
            if np.isinf(cell.df):
                square = np.einsum("ni,ni->n", e, e)[:, None]
                log_p = -0.5 * square / self.scales**2 - 0.5 * num * LOG_2PI
            else:
                log_p = student(e[:, None] / self.scales[:, None], cell.df).sum(-1)
            log_p = log_p - num * np.log(self.scales) - cell.log_scale
            parts.append(prior + self.log_scale_prior + log_p)
        return np.stack(parts, 1)

    def posterior(self, residual: Array) -> Array:
        """Return the probability of cells and scales, shape (cells, scales)."""
        joint = self.joint(residual[None])[0]
        return np.exp(joint - log_sum_exp(joint))

    @override
    def start(self) -> Whitener:
        cell, scale = self._typical()
        return lambda residual: cell.whiten(residual) / scale

    @override
    def whitener(self, residual: Array) -> Whitener:
        best = np.unravel_index(np.argmax(self.joint(residual[None])[0]), self.shape)
        cell, scale = self.cells[best[0]], self.scales[best[1]]
        return lambda residual: cell.whiten(residual) / scale

    @override
    def noise_posterior(
        self, residual: Array, rng: np.random.Generator
    ) -> tuple[NDArray[np.intp], Array]:
        cell, scale = drawn(self.joint(residual), rng)
        return cell, self.sizes(self.scales[scale])

    def sizes(self, scales: Array) -> Array:
        """Return the sizes of :meth:`noise_posterior` that scales (n,) stand for."""
        return scales

    def by_number(self, sizes: Array) -> Array:
        """Return the size of each number, shape (n, N), from those of draws."""
        return np.broadcast_to(sizes[:, None], (len(sizes), len(self.cells[0].sd)))

    @property
    def typical_sd(self) -> Array:
        """Geometric mean over the cells, shape (N,)."""
        return np.exp(np.mean([np.log(cell.sd) for cell in self.cells], 0))

    @property
    def shape(self) -> tuple[int, int]:
        """Numbers of cells and scales."""
        return len(self.cells), len(self.scales)

    def scaled(self, scales: Array, log_weights: Array) -> NoiseGrid:
        """Return this noise with further factors on its standard deviation."""
        product = np.multiply.outer(self.scales, scales).ravel()
        weight = np.add.outer(self.log_scale_prior, log_weights).ravel()
        return NoiseGrid(self.cells, scales=product, log_weights=weight)

    def with_extra(self, sd: Array) -> NoiseGrid:
        """Return this noise with an independent error of deviation sd, shape (N,)."""
        cells = [replace(cell, sd=np.hypot(cell.sd, sd)) for cell in self.cells]
        return self.of_cells(cells)

    def settled(self, residual: Callable[[], Array]) -> NoiseGrid:
        """Return this noise with one unknown size, where each channel has its own.

        Args:
            residual: Function that returns a residual that tells the ratio of sizes,
                shape (N,).
        """
        return self

    def part(self, at: NDArray[np.bool_]) -> NoiseGrid:
        """Return this noise of some of the numbers, shape (N,)."""
        cells = [replace(c, sd=c.sd[at], rho=c.rho[at]) for c in self.cells]
        return self.of_cells(cells)

    def of_cells(self, cells: list[NoiseCell]) -> NoiseGrid:
        """Return noise of other cells, and sizes as here."""
        return NoiseGrid(cells, scales=self.scales, log_weights=self.log_scale_prior)

    def _typical(self) -> tuple[NoiseCell, float]:
        middle = np.argsort(self.scales)[len(self.scales) // 2]
        return self.cells[int(np.argmax(self.log_prior))], float(self.scales[middle])


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

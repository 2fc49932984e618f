r"""Distributions of the measurement error, with what is unknown summed out.

The correlation time and the size of the noise belong to the bare model and to every
rival alike. Each is a grid, so that a likelihood is a sum over its cells and no rival
pays for them with a coordinate.

Where the size is unknown in each channel by itself, fits tell the ratio of the sizes:
that of the bare model, and that of the single effect which leaves least; their common
factor is summed out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from sbi_active.arrays import Array
from sbi_active.criticism.data.measurements import Measurements
from sbi_active.criticism.rivals.heavy_tails import student
from sbi_active.inference.sampling.weights import log_sum_exp
from sbi_active.seeding import forked_generators
from sbi_active.simulation.noise.base import NoiseModel
from sbi_active.simulation.noise.posterior import NoisePosterior, SdGrid

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
        log_weights: Log prior probabilities of these, shape (j,), or (1,) if equal.
        is_by_channel: Whether each channel has a size of its own, which nothing says:
            fits tell them (:meth:`sized`), and ``scales`` is their common factor.
    """

    cells: Sequence[NoiseCell]
    scales: Array = field(default_factory=lambda: np.ones(1))
    log_weights: Array = field(default_factory=lambda: np.zeros(1))
    is_by_channel: bool = False

    @cached_property
    def log_prior(self) -> Array:
        """Log prior probability of each cell."""
        weights = np.array([cell.log_weight for cell in self.cells])
        return weights - log_sum_exp(weights)

    @cached_property
    def log_scale_prior(self) -> Array:
        """Log prior probability of each scale."""
        weights = np.broadcast_to(self.log_weights, self.scales.shape)
        return weights - log_sum_exp(weights)

    @property
    def is_known(self) -> bool:
        """Whether nothing of it is unknown, so that one transform whitens all."""
        return len(self.cells) == len(self.scales) == 1

    @cached_property
    def has_size(self) -> bool:
        """Whether its size is declared, and its correlation at most unknown."""
        apart = np.ptp([cell.sd for cell in self.cells], axis=0)
        return len(self.scales) == 1 and not apart.any()

    @property
    def typical_sd(self) -> Array:
        """Geometric mean over the cells, shape (N,)."""
        return np.exp(np.mean([np.log(cell.sd) for cell in self.cells], 0))

    def log_likelihood(self, residual: Array) -> Array:
        """Return log densities, shape (n,), of residuals, shape (n, N)."""
        return log_sum_exp(self.joint(residual).reshape(len(residual), -1), axis=1)

    def joint(self, residual: Array) -> Array:
        """Return log p(residual, cell, scale), shape (n, cells, scales)."""
        parts, num = [], residual.shape[1]
        for cell, prior in zip(self.cells, self.log_prior, strict=True):
            e = cell.whiten(residual)
            if np.isinf(cell.df):
                each = -0.5 * (e**2).sum(1)[:, None] / self.scales**2
                each = each - 0.5 * num * LOG_2PI
            else:
                each = student(e[:, None] / self.scales[:, None], cell.df).sum(2)
            each = each - num * np.log(self.scales) - cell.log_scale
            parts.append(prior + self.log_scale_prior + each)
        return np.stack(parts, 1)

    def posterior(self, residual: Array) -> Array:
        """Return the probability of cells and scales, shape (cells, scales)."""
        joint = self.joint(residual[None])[0]
        return np.exp(joint - log_sum_exp(joint))

    @cached_property
    def start(self) -> Whitener:
        """The whitening transform to start a least-squares search with."""
        middle = np.argsort(self.scales)[len(self.scales) // 2]
        return self._whitener(int(np.argmax(self.log_prior)), int(middle))

    def whitener(self, residual: Array) -> Whitener:
        """Return the whitening transform that a residual (N,) makes most probable.

        It maps (..., N) to (..., N), linearly.
        """
        joint = self.joint(residual[None])[0]
        cell, scale = np.unravel_index(np.argmax(joint), joint.shape)
        return self._whitener(int(cell), int(scale))

    def noise_posterior(
        self, residual: Array, rng: np.random.Generator
    ) -> tuple[NDArray[np.intp], Array]:
        """Return a cell and a size of the noise for each residual, at random.

        Args:
            residual: Residuals, shape (n, N).
            rng: Source of the draws.

        Returns:
            Cells, and factors on their deviations, shapes (n,).
        """
        cells, scales = drawn(self.joint(residual), rng)
        return cells, self.scales[scales]

    def errors(
        self, cells: Array, sizes: Array, rng: np.random.Generator
    ) -> tuple[Array, Array]:
        """Return errors at random, and their deviations, shape (n, N).

        Args:
            cells: Cell of each draw, shape (n,).
            sizes: Factors on the cell's deviations, shape (n,).
            rng: Source of the errors.
        """
        own = [self.cells[cell] for cell in cells]
        rho = np.stack([cell.rho for cell in own])
        u = rng.normal(size=rho.shape)
        for row, cell in zip(u, own, strict=True):
            if np.isfinite(df := cell.df):
                row[:] = rng.standard_t(df, size=len(row)) * np.sqrt((df - 2) / df)
        for k in range(1, u.shape[1]) if rho.any() else ():
            step = np.sqrt(1 - rho[:, k] ** 2) * u[:, k]
            u[:, k] = rho[:, k] * u[:, k - 1] + step
        sd = np.stack([cell.sd for cell in own]) * sizes[:, None]
        return u * sd, sd

    def log_density(self, cells: Array, sizes: Array, residual: Array) -> Array:
        """Return log densities of residuals (n, N), each in its cell, shape (n,)."""
        log_p, u = np.empty(len(residual)), residual / sizes[:, None]
        for cell in np.unique(cells):
            own, alone = cells == cell, replace(self.cells[cell], log_weight=0.0)
            log_p[own] = NoiseGrid([alone]).log_likelihood(u[own])
        return log_p - residual.shape[1] * np.log(sizes)

    def scaled(self, factors: Array) -> NoiseGrid:
        """Return this noise with further factors on its size, equally likely."""
        product = np.multiply.outer(self.scales, factors).ravel()
        weight = np.repeat(self.log_scale_prior, len(factors))
        return replace(self, scales=product, log_weights=weight)

    def sized(self, sds: Sequence[Array]) -> NoiseGrid:
        """Return this noise with one of some deviations, each of shape (N,)."""
        cells = [replace(c, sd=sd) for sd in sds for c in self.cells]
        return replace(self, cells=cells)

    def with_extra(self, sd: Array) -> NoiseGrid:
        """Return this noise with an independent error of deviation sd, shape (N,)."""
        cells = [replace(cell, sd=np.hypot(cell.sd, sd)) for cell in self.cells]
        return replace(self, cells=cells)

    def part(self, at: NDArray[np.bool_]) -> NoiseGrid:
        """Return this noise of some of the numbers, shape (N,)."""
        return replace(self, cells=[cell.part(at) for cell in self.cells])

    def _whitener(self, cell: int, scale: int) -> Whitener:
        own, size = self.cells[cell], self.scales[scale]
        return lambda residual: own.whiten(residual) / size


def drawn(log_p: Array, rng: np.random.Generator) -> tuple[NDArray[np.intp], ...]:
    """Return a place (n,) in each axis of unnormalized log densities (n, ...)."""
    flat = log_p.reshape(len(log_p), -1)
    best = np.argmax(flat + rng.gumbel(size=flat.shape), axis=1)  # of softmax
    return np.unravel_index(best, log_p.shape[1:])


#: Cells of the correlation time, from half a sample step to twice the recording, and
#: the prior probability of no correlation at all.
NUM_TIMES, INDEPENDENT = 14, 0.3
#: Draws that stand for a posterior over noise parameters.
NUM_DRAWS = 24
#: Sizes of what is beside the sensor's error in its deviations, a factor apart.
SMALLEST, LARGEST, FACTOR = 0.3, 40.0, 1.63


def declared_noise(
    noise: NoiseModel | None, measurements: Measurements, *, seed: int = 0
) -> NoiseGrid:
    """Return the errors that a declared noise model gives to the measurements.

    Along a time axis, noise that says nothing of a correlation has an unknown one: the
    correlation time is log-uniform, or zero. A posterior over the noise's parameters is
    represented by draws, or summed if it is a grid of a size and a correlation time.

    Args:
        noise: Noise of the simulator; None if the simulator is the draw, and its own
            deviation is the unit.
        measurements: Measured numbers.
        seed: Seed of the draws of the posterior.

    Raises:
        ValueError: If a declared standard deviation is zero.
    """
    if noise is None:
        return NoiseGrid(_correlated(measurements, np.ones(len(measurements))))
    names, rows = noise.parameter_names, noise.parameters[None]
    if noise.posterior is not None:
        if (grid := _product(noise, measurements)) is not None:
            return grid
        with forked_generators(seed, "noise"):
            rows = noise.posterior.sample(torch.Size([NUM_DRAWS])).double()
        rows = rows.reshape(NUM_DRAWS, -1)  # of one parameter they may be numbers
    cells: list[NoiseCell] = []
    weight = -np.log(len(rows))
    for row in rows:
        values = dict(zip(names, row.tolist(), strict=True))
        sds = np.array([v for k, v in values.items() if k.startswith("sd")])
        if not len(sds):  # a noise model of the user's, taken as Gaussian of its size
            sds = noise.declared_sds().numpy()
        if (sds <= 0).any():
            raise ValueError(
                "expected measurement noise with a standard deviation > 0; got "
                f"{noise}; declare the error of the measurement, since without one "
                "any residual is an effect"
            )
        sd = sds[_channel_of(measurements, len(sds))]
        df = values.get("df", np.inf)
        tau = values.get("correlation_time")
        if tau is None and measurements.has_time and np.isinf(df):
            cells += _correlated(measurements, sd, weight)
            continue
        own = {"correlation_time": tau or 0.0, "df": df, "log_weight": weight}
        cells.append(NoiseCell.of(measurements, sd=sd, **own))
    return NoiseGrid(cells)


def _product(noise: NoiseModel, measurements: Measurements) -> NoiseGrid | None:
    """Return the sum over a grid of standard deviations times a correlation time.

    None unless the posterior is such a grid with independent parts, as one is that
    stands for noise of unknown size, in all channels or in each: a few draws of it
    would miss what the trials tell of the size to some percent.
    """
    posterior = noise.posterior
    if "correlation_time" not in noise.parameter_names or not (
        isinstance(posterior, NoisePosterior) and isinstance(posterior.sd, SdGrid)
    ):
        return None
    sd, weights = posterior.sd, posterior.sd.log_weight
    if not torch.equal(weights, weights[:1].expand_as(weights)):
        return None
    middle = (weights[0].exp() * sd.nodes.log()).sum(1).exp()
    unit = middle.numpy()[_channel_of(measurements, sd.num_channels)]
    cells = [
        NoiseCell.of(measurements, sd=unit, correlation_time=tau, log_weight=log_p)
        for tau, log_p in posterior.cells
    ]
    if sd.num_channels == 1:
        factors = (sd.nodes / middle[:, None]).numpy()[0]
        return NoiseGrid(cells, scales=factors, log_weights=weights[0, 0].numpy())
    # From a thirtieth of the sizes that fits tell to thirty times these.
    return NoiseGrid(cells, scales=np.geomspace(1 / 30, 30, 40), is_by_channel=True)


def measurement_sds(noise: NoiseModel | None, measurements: Measurements) -> Any:
    """Return the declared error of the sensor alone, None if there is none.

    Args:
        noise: The simulator's.
        measurements: Measured numbers.

    Returns:
        A number, or where channels have their own one a measured number, shape (N,).
    """
    sd = getattr(noise, "measurement_sd", None)
    if not isinstance(sd, torch.Tensor):
        return sd
    return sd.numpy()[_channel_of(measurements, len(sd))]


def sizes(largest: float) -> Array:
    """Return sizes of what is beside the sensor's error, in its deviations.

    Args:
        largest: The largest one.
    """
    num = 1 + round(np.log(largest / SMALLEST) / np.log(FACTOR))
    return np.geomspace(SMALLEST, largest, num)


def _correlated(
    measurements: Measurements, sd: Array, log_weight: float = 0.0
) -> list[NoiseCell]:
    if not measurements.is_sequence:
        return [NoiseCell.of(measurements, sd=sd, log_weight=log_weight)]
    times = np.geomspace(0.5 * measurements.step, 2 * measurements.span, NUM_TIMES)
    each = np.full(NUM_TIMES, np.log1p(-INDEPENDENT) - np.log(NUM_TIMES))
    some = zip([0.0, *times], [np.log(INDEPENDENT), *each], strict=True)
    return [
        NoiseCell.of(measurements, sd=sd, correlation_time=t, log_weight=log_weight + w)
        for t, w in some
    ]


def _channel_of(measurements: Measurements, num: int) -> NDArray[np.int64]:
    """Return the index of the declared standard deviation of each number."""
    if num == 1:
        return np.zeros(len(measurements), dtype=np.int64)
    last = measurements.shape[-1]
    if last != num:
        raise ValueError(
            f"expected a standard deviation for each of {last} channels; got {num}; "
            "give one an entry of x's last axis"
        )
    return measurements.position % last

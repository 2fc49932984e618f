"""Noise that is correlated along a trajectory."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution
from typing_extensions import Self, override

from sbi_active.arrays import own_tensor
from sbi_active.simulation.noise.base import LOG_2PI, ScaleNoise, standard_normals
from sbi_active.simulation.noise.posterior import Cells, NoisePosterior, SdGrid


class AutocorrelatedNoise(ScaleNoise):
    r"""Gaussian noise whose correlation decays exponentially with the time between.

    The stationary Ornstein-Uhlenbeck process, independent in each channel,

    .. math::
        \mathrm{cov}(e_s, e_t) = \sigma^2 \exp(-|t - s| / \tau), \qquad
        e_t | e_s \sim N(\rho e_s, \sigma^2 (1 - \rho^2)), \quad
        \rho = \exp(-(t - s) / \tau),

    exact at irregular time stamps, and with masked numbers skipped. Time is the first
    axis of x; where x has more axes, channels are the last.

    Args:
        sd: Standard deviation :math:`\sigma`, in the units of x; a number, or one a
            channel.
        correlation_time: :math:`\tau` in seconds, of all channels. Without time stamps
            it counts samples.
        posterior: Posterior of (sd, correlation_time), event shape (p,).
        measurement_sd: Known standard deviation of the measurement alone, where the
            rest of an unknown sd is what a simulator gets wrong, a number or one a
            channel; None if nothing is known of it.

    Raises:
        ValueError: If a parameter is negative or not finite.

    References:
        Uhlenbeck & Ornstein, Physical Review 36 (1930).

    Example:
        >>> noise = AutocorrelatedNoise(1.0, 4.0)
        >>> x = noise.sample(torch.zeros(3, 50))
        >>> noise.log_prob(x, torch.zeros(3, 50)).shape
        torch.Size([3])
    """

    def __init__(
        self,
        sd: float | Tensor,
        correlation_time: float | Tensor,
        *,
        posterior: Distribution | None = None,
        measurement_sd: float | Tensor | Sequence[float] | None = None,
    ) -> None:
        super().__init__(
            sd, shared={"correlation_time": correlation_time}, posterior=posterior
        )
        self.measurement_sd = _measurement_sd(measurement_sd)

    @classmethod
    def unknown(
        cls,
        *,
        sd: tuple[float, float] | Sequence[tuple[float, float]],
        correlation_time: tuple[float, float],
        measurement_sd: float | Tensor | Sequence[float] | None = None,
        num_sds: int = 40,
        num_times: int = 12,
    ) -> Self:
        r"""Return noise of which only the orders of magnitude are known.

        Its parameters have log-uniform priors. Use it for trajectories without error
        bars: errors of the simulator itself count as such noise as long as nothing
        explains them better.

        Args:
            sd: Bounds of the standard deviation, in the units of x; or a pair a
                channel, whose sizes are then unknown one by one.
            correlation_time: Bounds, s; well below the distance of samples, errors are
                independent.
            measurement_sd: Standard deviation of the sensor alone, where it is known, a
                number or one a channel. Errors beyond it are the simulator's, and a
                verdict then says what helps to predict and what is probably the cause
                (:mod:`.misfit`).
            num_sds: Nodes of the grid over standard deviations.
            num_times: Nodes of the grid over correlation times.

        Raises:
            ValueError: If bounds are not positive and in order.

        Example:
            >>> noise = AutocorrelatedNoise.unknown(
            ...     sd=(0.1, 1.0), correlation_time=(0.01, 1.0))
            >>> noise.posterior.sample((3,)).shape
            torch.Size([3, 2])
        """
        several = torch.as_tensor(sd).ndim == 2
        pairs: Any = [*sd] if several else [sd]
        for name, (low, high) in (
            *(("sd", pair) for pair in pairs),
            ("correlation_time", correlation_time),
        ):
            if not 0 < low < high:
                raise ValueError(
                    f"expected bounds 0 < low < high of {name}; got {low:g} and "
                    f"{high:g}; pass the orders of magnitude that are possible"
                )
        sds = torch.stack([_edges(low, high, num_sds) for low, high in pairs])
        times = _edges(*correlation_time, num_times)
        prior = NoisePosterior(
            SdGrid(sds, _uniform(num_sds).expand(num_times, len(pairs), num_sds)),
            shared=Cells(times, _uniform(num_times)),
        )
        middles = [(low * high) ** 0.5 for low, high in (*pairs, correlation_time)]
        each = torch.tensor(middles[:-1], dtype=torch.float64)
        return cls(
            each if several else middles[0],
            correlation_time=middles[-1],
            posterior=prior,
            measurement_sd=measurement_sd,
        )

    def _check(self, parameters: Tensor) -> None:
        super()._check(parameters)
        tau = parameters[..., -1]
        if not bool((tau.isfinite() & (tau >= 0)).all()):
            raise ValueError(
                f"expected a correlation time >= 0; got {tau.tolist()}; give it in "
                "seconds"
            )

    def _check_shape(self, shape: torch.Size) -> None:
        if len(shape) == 2 and self._num_sd > 1:
            raise ValueError(
                f"expected outcomes of shape (n, T, {self._num_sd}), time before "
                f"channels; got {tuple(shape)}; give one standard deviation where x "
                "has a time axis only"
            )
        super()._check_shape(shape)

    def _draw(self, seeds: Tensor | None, shape: torch.Size, rows: Tensor) -> Tensor:
        normal = standard_normals(seeds, shape).reshape(len(rows), shape[1], -1)
        ratio = time_stamps(self.times, shape).diff() / rows[:, -1:]
        rho, spread = torch.exp(-ratio), (-torch.expm1(-2 * ratio)).sqrt()
        path = [normal[:, 0]]
        for t in range(shape[1] - 1):
            path.append(
                rho[:, t, None] * path[-1] + spread[:, t, None] * normal[:, t + 1]
            )
        noise = torch.stack(path, 1).reshape(shape)
        return self._spread(rows[:, :-1], shape) * noise

    def _log_density(self, residual: Tensor, rows: Tensor) -> Tensor:
        tau, sd = rows[:, -1], rows[:, :-1]
        square, log_factor, count = self._summed(residual, tau)
        density = -0.5 * square / sd**2 - count * (sd.log() + 0.5 * LOG_2PI)
        return (density - 0.5 * log_factor).sum(1)

    def _log_evidence(self, residual: Tensor, p: NoisePosterior, cell: int) -> Tensor:
        tau = torch.full_like(residual[:, 0].flatten(1)[:, 0], p.cells[cell][0])
        square, log_factor, count = self._summed(residual, tau)
        return p.sd.log_evidence(square, count, cell) - 0.5 * log_factor

    def _summed(self, residual: Tensor, tau: Tensor) -> Sequence[Tensor]:
        """Return squares of innovations, log factors and counts, (n, channels)."""
        parts = innovations(residual, tau, self.times)
        return [*map(self._by_channel, (*parts, (~residual.isnan()).double()))]

    @override
    def whiten(self, value: Tensor) -> Tensor:
        v = value.double()
        tau = self.parameters[-1].double().expand(len(v))
        change, variance = chained(v, tau, self.times)
        return super().whiten((change / variance.sqrt()).reshape(v.shape))


def innovations(
    residual: Tensor, tau: Tensor, times: Tensor | None
) -> tuple[Tensor, Tensor]:
    r"""Whiten residuals, up to the standard deviation, by the Markov chain.

    .. math::
        u_t = \frac{e_t - \rho e_s}{\sqrt{1 - \rho^2}}, \qquad
        \log |R| = \sum_t \log(1 - \rho^2),

    with s the last time observed before t, and :math:`u_t = e_t` where there is none.

    Args:
        residual: Residuals, shape (n, T, ...), NaN where not observed.
        tau: Correlation times, shape (n,).
        times: Times, shape (T,) or (n, T); None for 0, 1, 2, ...

    Returns:
        :math:`u_t^2` and :math:`\log(1 - \rho^2)`, zero if not observed, shapes (n,
        T, rest).
    """
    change, variance = chained(residual, tau, times)
    observed = ~change.isnan()
    square, log_factor = change.square() / variance, variance.log()
    return torch.where(observed, square, 0.0), torch.where(observed, log_factor, 0.0)


def chained(
    residual: Tensor, tau: Tensor, times: Tensor | None
) -> tuple[Tensor, Tensor]:
    r"""Return the innovation at each time, and its variance in those of the residual.

    Arguments are those of :func:`innovations`.

    Returns:
        :math:`e_t - \rho e_s`, NaN where not observed, and :math:`1 - \rho^2`, shapes
        (n, T, rest).
    """
    e = residual.flatten(2) if residual.ndim > 2 else residual[..., None]
    stamp = time_stamps(times, residual.shape).to(e.device)[..., None].expand(e.shape)
    observed = ~e.isnan()
    index = torch.arange(e.shape[1], device=e.device)[:, None].expand(e.shape[1:])
    index = torch.where(observed, index, -1)
    before = torch.full_like(index[:, :1], -1)
    before = torch.cat([before, index.cummax(1).values[:, :-1]], 1)
    source = before.clamp_min(0)
    first = before < 0
    step = torch.where(first, torch.inf, stamp - stamp.gather(1, source))
    ratio = step / tau[:, None, None]
    rho, variance = torch.exp(-ratio), -torch.expm1(-2 * ratio)
    past = torch.where(first, 0.0, e.gather(1, source))
    return e - rho * past, variance


def time_stamps(times: Tensor | None, shape: Sequence[int]) -> Tensor:
    """Return time stamps of every row of (n, T, ...), shape (n, T), float64.

    Raises:
        ValueError: If they do not fit x's time axis or do not increase.
    """
    n, num = shape[0], shape[1]
    if times is None:
        return torch.arange(num, dtype=torch.float64).expand(n, num)
    times = torch.as_tensor(times, dtype=torch.float64)
    if times.shape not in ((num,), (n, num)):
        raise ValueError(
            f"expected times of shape ({num},) or ({n}, {num}), one a sample of x's "
            f"first axis; got {tuple(times.shape)}; give the stamps of x {(*shape,)}"
        )
    if not bool((times.diff() > 0).all()):
        raise ValueError(
            f"expected times that increase; got {times.tolist()}; sort x by time "
            "and drop repeated stamps"
        )
    return times.expand(n, num)


def _measurement_sd(
    value: float | Tensor | Sequence[float] | None,
) -> float | Tensor | None:
    """Return a number, or a copy of one a channel, or raise where one is not > 0."""
    if value is None:
        return None
    sds = own_tensor(value, torch.float64, name="measurement_sd")
    if sds.ndim > 1 or not bool(((sds > 0) & sds.isfinite()).all()):
        raise ValueError(
            f"expected measurement_sd > 0; got {value}; give the sensor's error in the "
            "units of x, one number or one a channel, or None"
        )
    return sds if sds.numel() > 1 else float(sds)


def _edges(low: float, high: float, num: int) -> Tensor:
    share = torch.linspace(0, 1, num + 1, dtype=torch.float64)
    return low * (high / low) ** share


def _uniform(num: int) -> Tensor:
    return -torch.full((num,), float(num), dtype=torch.float64).log()

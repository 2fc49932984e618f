"""Noise that is correlated along a trajectory."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from typing_extensions import Self, override

from sbi_active.arrays import own_tensor
from sbi_active.expected import require
from sbi_active.simulation.noise.base import ScaleNoise, standard_normals
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

    _num_axes = 2

    def __init__(
        self,
        sd: float | Tensor,
        correlation_time: float | Tensor,
        *,
        posterior: NoisePosterior | None = None,
        measurement_sd: float | Tensor | Sequence[float] | None = None,
    ) -> None:
        super().__init__(sd, posterior=posterior, correlation_time=correlation_time)
        self.measurement_sd = None
        if measurement_sd is not None:
            sds = own_tensor(measurement_sd, torch.float64, name="measurement_sd")
            is_positive = sds.ndim < 2 and bool(((sds > 0) & sds.isfinite()).all())
            advice = "give the sensor's error in the units of x, one number or one a "
            advice += "channel, or None"
            require(is_positive, "measurement_sd > 0", measurement_sd, advice)
            self.measurement_sd = sds if sds.numel() > 1 else float(sds)

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
        for low, high in (*pairs, correlation_time):
            expected = "bounds 0 < low < high of sd and correlation_time"
            advice = "pass the orders of magnitude that are possible"
            require(0 < low < high, expected, f"{low:g} and {high:g}", advice)
        sds = torch.stack([_edges(low, high, num_sds) for low, high in pairs])
        times = _edges(*correlation_time, num_times)
        each = _uniform(num_sds).expand(num_times, len(pairs), num_sds)
        middles = [(low * high) ** 0.5 for low, high in pairs]
        return cls(
            torch.tensor(middles, dtype=torch.float64) if several else middles[0],
            (correlation_time[0] * correlation_time[1]) ** 0.5,
            posterior=NoisePosterior(
                SdGrid(sds, each), shared=Cells(times, _uniform(num_times))
            ),
            measurement_sd=measurement_sd,
        )

    @override
    def _draw(self, seeds: Tensor | None, shape: torch.Size, rows: Tensor) -> Tensor:
        normal = standard_normals(seeds, shape).reshape(len(rows), shape[1], -1)
        ratio = time_stamps(self.times, shape).diff() / rows[:, -1:]
        rho, spread = torch.exp(-ratio), (-torch.expm1(-2 * ratio)).sqrt()
        path = [normal[:, 0]]
        for t in range(shape[1] - 1):
            path.append(
                rho[:, t, None] * path[-1] + spread[:, t, None] * normal[:, t + 1]
            )
        return self._by_row(rows, shape) * torch.stack(path, 1).reshape(shape)

    @override
    def _innovations(self, residual: Tensor, shared: float) -> tuple[Tensor, Tensor]:
        return innovations(residual, shared, self.times)


def innovations(
    residual: Tensor, tau: float, times: Tensor | None
) -> tuple[Tensor, Tensor]:
    r"""Whiten residuals, up to the standard deviation, by the Markov chain.

    .. math::
        u_t = \frac{e_t - \rho e_s}{\sqrt{1 - \rho^2}}, \qquad
        \log |R| = \sum_t \log(1 - \rho^2),

    with s the last time observed before t, and :math:`u_t = e_t` where there is none.

    Args:
        residual: Residuals, shape (n, T, ...), NaN where not observed.
        tau: Correlation time.
        times: Times, shape (T,) or (n, T); None for 0, 1, 2, ...

    Returns:
        :math:`u_t` and :math:`\log(1 - \rho^2)`, NaN where not observed, of the
        residual's shape.
    """
    e = residual.reshape(*residual.shape[:2], -1)
    stamp = time_stamps(times, residual.shape).to(e.device)[..., None].expand(e.shape)
    place = torch.arange(e.shape[1], device=e.device)[:, None]
    last = torch.where(e.isnan(), -1, place).cummax(1).values
    before = torch.nn.functional.pad(last[:, :-1], (0, 0, 1, 0), value=-1)
    first, source = before < 0, before.clamp_min(0)
    ratio = torch.where(first, torch.inf, stamp - stamp.gather(1, source)) / tau
    variance = -torch.expm1(-2 * ratio)
    past = torch.where(first, 0.0, e.gather(1, source))
    u = (e - torch.exp(-ratio) * past) / variance.sqrt()
    log_variance = torch.where(e.isnan(), torch.nan, variance.log())
    return u.reshape(residual.shape), log_variance.reshape(residual.shape)


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


def _edges(low: float, high: float, num: int) -> Tensor:
    share = torch.linspace(0, 1, num + 1, dtype=torch.float64)
    return low * (high / low) ** share


def _uniform(num: int) -> Tensor:
    return -torch.full((num,), float(num), dtype=torch.float64).log()

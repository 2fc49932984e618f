"""Errors of which only the orders of magnitude are known."""

from __future__ import annotations

import torch
from torch import Tensor

from sbi_active.simulation.noise.autocorrelated import AutocorrelatedNoise
from sbi_active.simulation.noise.posterior import Cells, NoisePosterior, SdGrid

__all__ = ["unknown_noise"]


def unknown_noise(
    *,
    sd: tuple[float, float],
    correlation_time: tuple[float, float],
    measurement_sd: float | None = None,
    num_sds: int = 40,
    num_times: int = 12,
) -> AutocorrelatedNoise:
    r"""Return autocorrelated noise whose parameters have log-uniform priors.

    For trajectories without error bars. What is wrong with the simulator itself passes
    for such errors as long as nothing better explains it.

    Args:
        sd: Bounds of the standard deviation, in the units of x.
        correlation_time: Bounds, s; well below the distance of samples, errors are
            independent.
        measurement_sd: Of the sensor alone, where it is known. Errors beyond it are the
            simulator's, and a trial then counts as one measurement of them
            (:mod:`.coarsening`).
        num_sds: Nodes of the grid over standard deviations.
        num_times: The same over correlation times.

    Raises:
        ValueError: If bounds are not positive and in order.

    Example:
        >>> noise = unknown_noise(sd=(0.1, 1.0), correlation_time=(0.01, 1.0))
        >>> noise.posterior.sample((3,)).shape
        torch.Size([3, 2])
    """
    for name, (low, high) in (("sd", sd), ("correlation_time", correlation_time)):
        if not 0 < low < high:
            raise ValueError(
                f"expected bounds 0 < low < high of {name}; got {low:g} and {high:g}; "
                "do give the orders of magnitude that are possible"
            )
    sds, times = _edges(*sd, num_sds), _edges(*correlation_time, num_times)
    prior = NoisePosterior(
        SdGrid(sds[None], _uniform(num_sds).expand(num_times, 1, num_sds)),
        shared=Cells(times, _uniform(num_times)),
    )
    middle = [(low * high) ** 0.5 for low, high in (sd, correlation_time)]
    return AutocorrelatedNoise(*middle, posterior=prior, measurement_sd=measurement_sd)


def _edges(low: float, high: float, num: int) -> Tensor:
    share = torch.linspace(0, 1, num + 1, dtype=torch.float64)
    return low * (high / low) ** share


def _uniform(num: int) -> Tensor:
    return -torch.full((num,), float(num), dtype=torch.float64).log()

"""Errors of which the orders of magnitude are known."""

from __future__ import annotations

import torch
from torch import Tensor

from sbi_active.simulation import AutocorrelatedNoise
from sbi_active.simulation.noise_posterior import Cells, NoisePosterior, SdGrid

__all__ = ["unknown_noise"]

NUM_SDS, NUM_TIMES = 16, 10


def unknown_noise(
    *, sd: tuple[float, float], correlation_time: tuple[float, float]
) -> AutocorrelatedNoise:
    r"""Return autocorrelated noise whose parameters have log-uniform priors.

    Args:
        sd: Bounds of the standard deviation, in the units of x.
        correlation_time: Bounds, s; well below the distance of samples, errors are
            independent.

    Example:
        >>> noise = unknown_noise(sd=(0.1, 1.0), correlation_time=(0.01, 1.0))
        >>> noise.posterior.sample((3,)).shape
        torch.Size([3, 2])
    """
    sds, times = _edges(*sd, NUM_SDS), _edges(*correlation_time, NUM_TIMES)
    prior = NoisePosterior(
        SdGrid(sds[None], _uniform(NUM_SDS).expand(NUM_TIMES, 1, NUM_SDS)),
        shared=Cells(times, _uniform(NUM_TIMES)),
    )
    middle = [(low * high) ** 0.5 for low, high in (sd, correlation_time)]
    return AutocorrelatedNoise(*middle, posterior=prior)


def _edges(low: float, high: float, num: int) -> Tensor:
    share = torch.linspace(0, 1, num + 1, dtype=torch.float64)
    return low * (high / low) ** share


def _uniform(num: int) -> Tensor:
    return -torch.full((num,), float(num), dtype=torch.float64).log()

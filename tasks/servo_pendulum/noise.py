"""Errors of unknown size and correlation."""

from __future__ import annotations

import torch

from sbi_active.simulation import AutocorrelatedNoise
from sbi_active.simulation.noise_posterior import Cells, NoisePosterior, SdGrid

__all__ = ["unknown_noise"]

#: Standard deviation, rad: from some quanta of the encoder to the size of the motion.
SMALLEST, LARGEST, NUM_SDS = 0.005, 0.5, 60
#: Correlation time, s: from a tenth of a sample's distance to the length of a trial.
SHORTEST, LONGEST, NUM_TIMES = 0.02, 6.0, 12
NO_TIME = 1e-6  # s; far below any distance of samples


def unknown_noise(*, correlated: bool = True) -> AutocorrelatedNoise:
    r"""Return autocorrelated noise whose parameters have log-uniform priors.

    The encoder rounds to 1.5 mrad, which is nothing beside what any simulator of the
    servo gets wrong: the error is mostly the model's own, and of unknown size.

    Args:
        correlated: False forces errors that are independent, of unknown size.
    """
    sd = _edges(SMALLEST, LARGEST, NUM_SDS)
    times = _edges(SHORTEST, LONGEST, NUM_TIMES)
    if not correlated:
        times = _edges(NO_TIME, 1.001 * NO_TIME, 1)
    num = len(times) - 1
    prior = NoisePosterior(
        SdGrid(sd[None], _uniform(NUM_SDS).expand(num, 1, NUM_SDS)),
        shared=Cells(times, _uniform(num)),
    )
    middle = float(times[0] * times[-1]) ** 0.5
    return AutocorrelatedNoise((SMALLEST * LARGEST) ** 0.5, middle, posterior=prior)


def _edges(low: float, high: float, num: int) -> torch.Tensor:
    ends = torch.tensor([low, high], dtype=torch.float64).log()
    return torch.linspace(
        float(ends[0]), float(ends[1]), num + 1, dtype=torch.float64
    ).exp()


def _uniform(num: int) -> torch.Tensor:
    return -torch.full((num,), float(num), dtype=torch.float64).log()

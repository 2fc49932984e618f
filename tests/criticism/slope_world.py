"""A slope, read with an error of a tenth."""

import torch
from sbi.utils import BoxUniform

from sbi_active import SimulatorModel

NOISE = 0.1
PRIOR = BoxUniform(-3 * torch.ones(1), 3 * torch.ones(1))


def model(fn=lambda theta, xi: theta * xi) -> SimulatorModel:
    """Return the slope, or another response, with the error of its sensor."""
    return SimulatorModel(fn, noise=NOISE)


MODEL = model()


def read(mean, seed: int | torch.Generator = 0) -> torch.Tensor:
    """Return what the sensor reads of a mean, by a seed or a generator."""
    gen = torch.Generator().manual_seed(seed) if isinstance(seed, int) else seed
    mean = torch.as_tensor(mean)
    return mean + NOISE * torch.randn(mean.shape, generator=gen)

"""A slope, read with an error of a tenth."""

import torch
from sbi.utils import BoxUniform

from sbi_active import SimulatorModel
from tests.effects import with_error

NOISE = 0.1
PRIOR = BoxUniform(-3 * torch.ones(1), 3 * torch.ones(1))


def model(fn=lambda theta, xi: theta * xi) -> SimulatorModel:
    """Return the slope, or another response, with the error of its sensor."""
    return SimulatorModel(fn, noise=NOISE)


MODEL = model()


def read(mean, seed: int | torch.Generator = 0) -> torch.Tensor:
    """Return what the sensor reads of a mean, by a seed or a generator."""
    return with_error(torch.as_tensor(mean), NOISE, seed)

"""A belief over [0, 1]^3 as a density on a grid."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from sbi_active.seeding import forked_generators

SIDE = 20  # cells along each parameter


class GridBelief:
    r"""A density that is constant within each of 20 x 20 x 20 cells.

    Args:
        log_density: At the middles of the cells, up to a constant, shape (8000,).
    """

    def __init__(self, log_density: Tensor) -> None:
        self.log_density = log_density.double().log_softmax(0) + 3 * math.log(SIDE)

    @staticmethod
    def middles() -> Tensor:
        """Return the middles of the cells, shape (8000, 3)."""
        line = (torch.arange(SIDE) + 0.5) / SIDE
        return torch.cartesian_prod(line, line, line)

    @classmethod
    def uniform(cls) -> GridBelief:
        """Return the prior."""
        return cls(torch.zeros(SIDE**3))

    def log_prob(self, theta: Tensor) -> Tensor:
        """Return log densities, (..., 3) -> (...)."""
        cell = (theta * SIDE).long().clamp(0, SIDE - 1)
        index = (cell[..., 0] * SIDE + cell[..., 1]) * SIDE + cell[..., 2]
        return self.log_density[index]

    def sample(self, shape: torch.Size) -> Tensor:
        """Return draws, shape (n, 3)."""
        index = self.log_density.softmax(0).multinomial(shape[0], replacement=True)
        return self.middles()[index] + (torch.rand(shape[0], 3) - 0.5) / SIDE

    def draws(self, num: int, seed: int) -> np.ndarray:
        """Return draws by a seed, shape (num, 3)."""
        with forked_generators(seed):
            return self.sample(torch.Size([num])).double().numpy()

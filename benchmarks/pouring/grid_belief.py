"""A belief over [0, 1]^3 as a density on a grid."""

from __future__ import annotations

import math

import torch
from torch import Tensor

__all__ = ["GridBelief"]

SIDE = 40  # cells along each parameter: half a standard deviation at the narrowest


class GridBelief:
    r"""A density that is constant within each of 40 x 40 x 40 cells.

    Args:
        log_density: At the middles of the cells, up to a constant, shape (64000,).
    """

    def __init__(self, log_density: Tensor) -> None:
        self.log_density = log_density.double().log_softmax(0) + 3 * math.log(SIDE)

    @staticmethod
    def middles() -> Tensor:
        """Return the middles of the cells, shape (64000, 3)."""
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

    def flattened(self, theta: Tensor, effective: float) -> GridBelief:
        r"""Return :math:`b^\tau` with the largest :math:`\tau \le 1` that rows support.

        Args:
            theta: Rows from the prior, shape (n, 3).
            effective: Sample size of their weights to reach, 0 for :math:`\tau = 1`.
        """
        low, high = 0.0, 1.0
        log_b = self.log_prob(theta)
        if _size(log_b) >= effective:
            return self
        for _ in range(30):
            middle = (low + high) / 2
            if _size(middle * log_b) >= effective:
                low = middle
            else:
                high = middle
        return GridBelief(low * self.log_density)


def _size(log_weight: Tensor) -> float:
    weight = log_weight.softmax(0)
    return float(1 / (weight**2).sum())

"""Measurement noise: what separates a simulator's output from an observation."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod

import torch
from torch import Tensor

from sbi_active.seeding import row_normals

__all__ = ["GaussianNoise", "NoiseModel"]


class NoiseModel(ABC):
    """Distribution of an observation around the simulator's noise-free output."""

    @abstractmethod
    def sample(self, mean: Tensor, seeds: Tensor | None = None) -> Tensor:
        """Return observations.

        Args:
            mean: Noise-free outputs, shape (n, *x_shape).
            seeds: One a row, shape (n,); None draws from torch's global generator.

        Returns:
            Shape (n, *x_shape).
        """

    @abstractmethod
    def log_prob(self, x: Tensor, mean: Tensor) -> Tensor:
        """Return the log density of observations.

        Args:
            x: Observations, shape (n, *x_shape).
            mean: Noise-free outputs, broadcastable to x.

        Returns:
            Shape (n,), float64.
        """


class GaussianNoise(NoiseModel):
    r"""Independent Gaussian noise, :math:`x \sim N(\mu, \sigma^2)`.

    Args:
        sd: Standard deviation, in the units of x; a number, or one a channel (the last
            axis of x).

    Raises:
        ValueError: If a standard deviation is negative or not finite.

    Example:
        >>> noise = GaussianNoise(2.0)
        >>> noise.log_prob(torch.zeros(1, 1), torch.zeros(1, 1)).item()
        -1.612...
    """

    def __init__(self, sd: float | Tensor) -> None:
        self.sd = torch.as_tensor(sd, dtype=torch.float64)
        if not bool((self.sd.isfinite() & (self.sd >= 0)).all()):
            raise ValueError(
                f"expected a standard deviation >= 0; got {sd}; do give it in the "
                "units of x"
            )

    def __repr__(self) -> str:
        return f"GaussianNoise(sd={self.sd.tolist()})"

    def sample(self, mean: Tensor, seeds: Tensor | None = None) -> Tensor:
        if seeds is None:
            normal = torch.randn(mean.shape, dtype=torch.float64)
        else:
            normal = row_normals(seeds, mean[0].numel()).reshape(mean.shape)
        return mean + (self.sd * normal).to(mean.dtype)

    def log_prob(self, x: Tensor, mean: Tensor) -> Tensor:
        z = (x.double() - mean.double()) / self.sd
        density = -0.5 * z**2 - torch.log(self.sd) - 0.5 * math.log(2 * math.pi)
        return density.flatten(1).sum(-1)

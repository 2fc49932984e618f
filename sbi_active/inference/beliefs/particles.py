"""Draws from a finite set of parameters."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.distributions import Distribution


class ParticleDraws(Distribution):
    """Parameters out of a finite set (p, theta_dim), each as likely.

    It has no density, only probabilities, so it is a belief to design with and none to
    train under.
    """

    arg_constraints = {}  # pyright: ignore

    def __init__(self, particles: Tensor) -> None:
        super().__init__(
            torch.Size(), torch.Size([particles.shape[1]]), validate_args=False
        )
        self.particles = particles

    def sample(self, sample_shape: Sequence[int] = torch.Size()) -> Tensor:
        """Return draws, shape (*sample_shape, theta_dim)."""
        return self.particles[torch.randint(len(self.particles), tuple(sample_shape))]

    def log_prob(self, value: Tensor) -> Tensor:
        """Return the log probability of each row, shape (...); -inf off the set."""
        among = (value[..., None, :] == self.particles).all(-1).any(-1)
        return torch.where(among, 1 / len(self.particles), 0.0).log()

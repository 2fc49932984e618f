"""A world with a closed form: x = action * theta + noise, theta ~ N(0, I)."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.distributions import MultivariateNormal

DIM = 2
PRIOR = MultivariateNormal(torch.zeros(DIM), torch.eye(DIM))


def simulator(theta: Tensor, action: Tensor) -> Tensor:
    return action * theta + torch.randn_like(theta)


def moments(x: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
    """Posterior mean and variance of each parameter."""
    variance = 1 / (1 + action**2)
    return variance * action * x, variance.expand_as(x)


def information(action: Tensor) -> Tensor:
    """Exact information gain, (a, 1) -> (a,)."""
    return DIM * 0.5 * torch.log1p(action[:, 0] ** 2)


class ExactModel:
    """The exact posterior as a model for the designer."""

    belief = PRIOR

    def __init__(self, spread: float = 1.0) -> None:
        self.spread = spread  # 1 is exact

    def log_posterior(self, theta: Tensor, x: Tensor, action: Tensor) -> Tensor:
        mean, variance = moments(x, action)
        z = (theta - mean) / (self.spread * variance.sqrt())
        scale = 0.5 * variance.log() + math.log(self.spread)
        return (-0.5 * z**2 - scale - 0.5 * math.log(2 * math.pi)).sum(-1)

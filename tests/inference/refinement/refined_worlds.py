"""Simulators that refined beliefs are tested on."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from sbi.utils import BoxUniform
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.seeding import forked_generators

BOX = BoxUniform(-5 * torch.ones(2), 5 * torch.ones(2))
CURVES: dict[str, Callable[[Tensor], Tensor]] = {
    "linear": lambda t: t,
    "sinh": lambda t: 5 * torch.sinh(t / 2.5) / math.sinh(2),
    "square": lambda t: t**2 / 2.5 - 5,
    "sine": lambda t: 5 * torch.sin(1.5 * t),
}


def numerical(variant: str = "linear", noise: str = "gaussian"):
    def simulator(theta: Tensor, action: Tensor) -> Tensor:
        mean = CURVES[variant](theta[:, :1]) * torch.exp(3 - action)
        mean = mean + theta[:, 1:] * action
        if noise == "uniform":
            return mean + math.sqrt(12) * (torch.rand_like(mean) - 0.5)
        return mean + torch.randn_like(mean)

    return simulator


def observe(simulator, theta: Tensor, action: Tensor, seed: int) -> Tensor:
    with forked_generators(seed):
        return simulator(theta.double().expand(len(action), -1), action.double())


def draws(belief: Distribution, num: int, seed: int = 0) -> Tensor:
    with forked_generators(seed):
        return belief.sample((num,))

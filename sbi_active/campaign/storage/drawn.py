"""Draws that stand for a prior and actions that readers cannot load.

A class of a user's own is not stored with a campaign. Draws of it are, by which a
campaign can be shown, told and corrected where nobody runs the user's programs.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution, constraints
from typing_extensions import override

from sbi_active.actions import ActionSpace, DiscreteActions
from sbi_active.inference.beliefs.belief import ParticleDraws
from sbi_active.seeding import forked_generators

#: Draws of each. A choice: a quantile is off by some 2 % of the draws, half as many 3 %
#: and twice as many 1.5 %, and the file of ten parameters has 100 kB.
NUM_DRAWS = 500


class DrawnPrior(ParticleDraws):
    """Stands for a prior, or for a belief under one, by draws; it has no density.

    Args:
        draws: Draws, shape (n, theta_dim).
        of: Distribution that they are of, which gives its moments where it has any.
    """

    support = constraints.real_vector  # pyright: ignore

    def __init__(self, draws: Tensor, of: Any = None) -> None:
        super().__init__(draws)
        try:
            self._mean, self._variance = of.mean.reshape(-1), of.variance.reshape(-1)
        except (AttributeError, NotImplementedError):
            self._mean, self._variance = draws.mean(0), draws.var(0)

    @property
    @override
    def mean(self) -> Tensor:
        return self._mean

    @property
    @override
    def variance(self) -> Tensor:
        return self._variance

    @override
    def log_prob(self, value: Tensor) -> Tensor:
        raise ValueError(
            "expected the density of the campaign's prior, which only its author can "
            "make again; got draws alone; load the campaign with prior="
        )


class DrawnActions(DiscreteActions):
    """Stands for an action space, by its draws; nobody knows what it contains."""

    @override
    def contains(self, action: Tensor) -> Tensor:
        return torch.ones(action.shape[:-1]).bool()


def drawn(thing: Distribution | ActionSpace, *, seed: int) -> DrawnPrior | DrawnActions:
    """Return what stands for a prior or an action space.

    Args:
        thing: Prior or action space.
        seed: Seed of the draws.
    """
    if isinstance(thing, ActionSpace):
        draws = thing.sample((NUM_DRAWS,), seed=seed)
        return DrawnActions(draws, names=thing.names, units=thing.units)
    with forked_generators(seed, "drawn"):
        draws = thing.sample(torch.Size([NUM_DRAWS])).reshape(NUM_DRAWS, -1)
    return DrawnPrior(draws, thing)

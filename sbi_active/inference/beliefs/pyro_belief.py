"""A belief as a Pyro distribution, to be the prior of the next model."""

from __future__ import annotations

from typing import Any

import torch
from pyro.distributions import TorchDistribution
from pyro.distributions.torch_distribution import ExpandedDistribution
from torch import Tensor
from torch.distributions import Distribution
from typing_extensions import override


class PyroBelief(TorchDistribution):
    """A distribution of an event shape (d,), as a Pyro sample site takes it.

    Args:
        belief: Belief that is drawn and scored.
    """

    arg_constraints = {}  # pyright: ignore

    def __init__(self, belief: Distribution) -> None:
        self.belief = belief
        super().__init__(torch.Size(), belief.event_shape, validate_args=False)

    @property
    @override
    def support(self) -> Any:
        return self.belief.support

    @override
    def sample(self, sample_shape: Any = ()) -> Tensor:
        return self.belief.sample(torch.Size(sample_shape))

    @override
    def log_prob(self, value: Tensor) -> Tensor:
        return self.belief.log_prob(value)

    @override
    def expand(self, batch_shape: Any, _instance: Any = None) -> Any:
        return ExpandedDistribution(self, torch.Size(batch_shape))

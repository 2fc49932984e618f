"""What a trial of an action contributes to the belief, as a network learned it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution

__all__ = ["ActionFactor"]


class ActionFactor(ABC):
    """A learned factor of the likelihood of a trial.

    Attributes:
        estimator: sbi's, of flat outcomes, parameters and actions.
        belief: The distribution of theta it was trained under.
        x_shape: Shape of one outcome.
        action_dim: Numbers in an action.
    """

    def __init__(
        self,
        estimator: Any,
        belief: Distribution | None,
        x_shape: torch.Size,
        action_dim: int,
    ) -> None:
        self.estimator = estimator.eval()
        self.belief = belief
        self.x_shape, self.action_dim = torch.Size(x_shape), action_dim

    def __repr__(self) -> str:
        return (
            f"{type(self).__name__}(x {tuple(self.x_shape)}, action "
            f"({self.action_dim},), {type(self.estimator).__name__})"
        )

    @abstractmethod
    def log_factor(self, theta: Tensor, x: Tensor, action: Tensor) -> Tensor:
        """Return the log likelihood up to a function of (x, action), shape (n,)."""

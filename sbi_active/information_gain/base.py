"""What an estimator of the expected information gain gets and gives."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor
from torch.distributions import Distribution

__all__ = ["Bound", "CandidateSimulations", "InformationGainEstimator"]

Bound = Literal["lower", "upper", "none"]


@dataclass(frozen=True)
class CandidateSimulations:
    """Outcomes of every candidate action at the same parameters.

    Attributes:
        theta: Draws from the belief, shape (n, theta_dim), common to all candidates.
        action: Candidates, shape (a, action_dim).
        x: Outcomes, shape (a, n, *x_shape); NaN where there was no measurement.
    """

    theta: Tensor
    action: Tensor
    x: Tensor

    def rows(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return theta, x and action with one row a pair, a * n rows each."""
        num_actions, num_samples = self.x.shape[:2]
        return (
            self.theta.repeat(num_actions, 1),
            self.x.flatten(0, 1),
            self.action.repeat_interleave(num_samples, 0),
        )


class InformationGainEstimator(ABC):
    r"""Estimator of :math:`I(\theta; x | \xi)` in nats for a set of candidates.

    Attributes:
        bound: Which side of the information the estimate's expectation lies on.
    """

    bound: Bound = "none"

    def __call__(
        self, model: Any, simulations: CandidateSimulations, belief: Distribution
    ) -> Tensor:
        r"""Return the contribution of every simulation; their mean is the estimate.

        Args:
            model: What was learned, see the estimator.
            simulations: Fresh simulations, not those the model was trained on.
            belief: Density of theta in the simulations.

        Returns:
            Shape (a, n), nats, float64.

        Raises:
            ValueError: If shapes do not fit.
        """
        theta, action, x = simulations.theta, simulations.action, simulations.x
        if x.ndim < 3 or x.shape[:2] != (len(action), len(theta)):
            raise ValueError(
                f"expected x of shape ({len(action)}, {len(theta)}, *x_shape), one "
                f"outcome a candidate and parameter set; got {tuple(x.shape)}; do "
                "simulate every candidate at the same parameters"
            )
        with torch.no_grad():
            return self._contributions(model, simulations, belief).double()

    @abstractmethod
    def _contributions(
        self, model: Any, simulations: CandidateSimulations, belief: Distribution
    ) -> Tensor:
        """Return the contributions, shape (a, n)."""

"""The ratio of likelihood to marginal of an outcome, by parameters and action."""

from __future__ import annotations

import torch
from sbi.neural_nets.ratio_estimators import RatioEstimator
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.inference.condition import action_rows, outcome_rows, pack

__all__ = ["ActionRatio"]


class ActionRatio:
    r"""Learned log ratio :math:`\log p(x | \theta, \xi) / p(x | \xi)`.

    Args:
        estimator: Of theta and packed (x, action).
        belief: The distribution of theta it was trained under, to which p(x | action)
            belongs.
        x_shape: Shape of one outcome.
        action_dim: Numbers in an action.

    Attributes:
        belief: As given.
    """

    def __init__(
        self,
        estimator: RatioEstimator,
        belief: Distribution | None,
        x_shape: torch.Size,
        action_dim: int,
    ) -> None:
        self.estimator = estimator.eval()
        self.belief = belief
        self.x_shape, self.action_dim = torch.Size(x_shape), action_dim

    def __repr__(self) -> str:
        return (
            f"ActionRatio(x {tuple(self.x_shape)}, action ({self.action_dim},), "
            f"{type(self.estimator).__name__})"
        )

    def log_ratio(self, theta: Tensor, x: Tensor, action: Tensor) -> Tensor:
        r"""Return :math:`\log r(\theta_i; x_i, \xi_i)` row by row.

        Args:
            theta: Shape (n, theta_dim).
            x: Shape (n, *x_shape); NaN throughout a row where there was no measurement.
            action: Shape (n, action_dim).

        Returns:
            Shape (n,).
        """
        rows = outcome_rows(x, self.x_shape)
        action = action_rows(action, self.action_dim, num_rows=len(rows))
        return self.estimator(theta.float(), pack(rows, action)).reshape(-1)

    def log_factor(self, theta: Tensor, x: Tensor, action: Tensor) -> Tensor:
        """Return the log ratio, shape (n,): its marginal does not depend on theta."""
        return self.log_ratio(theta, x, action)

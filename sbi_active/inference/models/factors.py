"""Learned factors that a trial of an action contributes to the belief."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution
from typing_extensions import override

from sbi_active.inference.rounds.condition import action_rows, outcome_rows, pack


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


class ActionLikelihood(ActionFactor):
    r"""Surrogate likelihood :math:`q(x | \theta, \xi)`, x flat for its network."""

    def log_likelihood(self, x: Tensor, theta: Tensor, action: Tensor) -> Tensor:
        r"""Return :math:`\log q(x_i | \theta_i, \xi_i)` row by row, shape (n,).

        Args:
            x: Outcomes, shape (n, *x_shape); NaN throughout a row where there was no
                measurement.
            theta: Parameters, shape (n, theta_dim).
            action: Actions, shape (n, action_dim).
        """
        outcome = outcome_rows(x, self.x_shape).flatten(1)
        return self.estimator.log_prob(outcome[None], self._condition(theta, action))[0]

    def log_likelihood_table(self, x: Tensor, theta: Tensor, action: Tensor) -> Tensor:
        r"""Return :math:`\log q(x_i | \theta_j, \xi)` of every pair, shape (n, m).

        Args:
            x: Outcomes, shape (n, *x_shape).
            theta: Parameters, shape (m, theta_dim).
            action: One action, shape (action_dim,).
        """
        outcome = outcome_rows(x, self.x_shape).flatten(1)
        pairs = outcome[:, None].expand(-1, len(theta), -1)
        return self.estimator.log_prob(pairs, self._condition(theta, action))

    @override
    def log_factor(self, theta: Tensor, x: Tensor, action: Tensor) -> Tensor:
        return self.log_likelihood(x, theta, action)

    def sample(self, theta: Tensor, action: Tensor) -> Tensor:
        """Return one outcome a row, shape (n, *x_shape); NaN for no measurement.

        Args:
            theta: Parameters, shape (n, theta_dim).
            action: Actions, shape (n, action_dim).
        """
        condition = self._condition(theta, action)
        with torch.no_grad():
            x = self.estimator.sample(torch.Size([1]), condition)[0]
        return x.reshape(-1, *self.x_shape)

    def _condition(self, theta: Tensor, action: Tensor) -> Tensor:
        rows = action_rows(action, self.action_dim, num_rows=len(theta))
        return torch.cat([theta.float(), rows], 1)


class ActionRatio(ActionFactor):
    r"""Learned log ratio :math:`\log p(x | \theta, \xi) / p(x | \xi)`.

    Its estimator is of theta and packed (x, action); p(x | action) belongs to its
    belief.
    """

    def log_ratio(self, theta: Tensor, x: Tensor, action: Tensor) -> Tensor:
        r"""Return :math:`\log r(\theta_i; x_i, \xi_i)` row by row, shape (n,).

        Args:
            theta: Parameters, shape (n, theta_dim).
            x: Outcomes, shape (n, *x_shape); NaN throughout a row where there was no
                measurement.
            action: Actions, shape (n, action_dim).
        """
        rows = outcome_rows(x, self.x_shape)
        action = action_rows(action, self.action_dim, num_rows=len(rows))
        return self.estimator(theta.float(), pack(rows, action)).reshape(-1)

    @override
    def log_factor(self, theta: Tensor, x: Tensor, action: Tensor) -> Tensor:
        return self.log_ratio(theta, x, action)  # its marginal knows no theta

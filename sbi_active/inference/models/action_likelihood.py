"""The surrogate likelihood of an outcome given parameters and action."""

from __future__ import annotations

import torch
from torch import Tensor

from sbi_active.inference.models.action_factor import ActionFactor
from sbi_active.inference.rounds.condition import action_rows, outcome_rows

__all__ = ["ActionLikelihood"]


class ActionLikelihood(ActionFactor):
    r"""Surrogate likelihood :math:`q(x | \theta, \xi)`, x flat for its network."""

    def log_likelihood(self, x: Tensor, theta: Tensor, action: Tensor) -> Tensor:
        r"""Return :math:`\log q(x_i | \theta_i, \xi_i)` row by row, shape (n,).

        Args:
            x: Shape (n, *x_shape); NaN throughout a row where there was no measurement.
            theta: Shape (n, theta_dim).
            action: Shape (n, action_dim).
        """
        outcome = outcome_rows(x, self.x_shape).flatten(1)
        return self.estimator.log_prob(outcome[None], self._condition(theta, action))[0]

    def log_likelihood_table(self, x: Tensor, theta: Tensor, action: Tensor) -> Tensor:
        r"""Return :math:`\log q(x_i | \theta_j, \xi)` of every pair, shape (n, m).

        Args:
            x: Shape (n, *x_shape).
            theta: Shape (m, theta_dim).
            action: One action, shape (action_dim,).
        """
        outcome = outcome_rows(x, self.x_shape).flatten(1)
        pairs = outcome[:, None].expand(-1, len(theta), -1)
        return self.estimator.log_prob(pairs, self._condition(theta, action))

    def log_factor(self, theta: Tensor, x: Tensor, action: Tensor) -> Tensor:
        """Return the log likelihood, shape (n,), see :meth:`log_likelihood`."""
        return self.log_likelihood(x, theta, action)

    def sample(self, theta: Tensor, action: Tensor) -> Tensor:
        """Return one outcome a row, shape (n, *x_shape); NaN for no measurement.

        Args:
            theta: Shape (n, theta_dim).
            action: Shape (n, action_dim).
        """
        condition = self._condition(theta, action)
        with torch.no_grad():
            x = self.estimator.sample(torch.Size([1]), condition)[0]
        return x.reshape(-1, *self.x_shape)

    def _condition(self, theta: Tensor, action: Tensor) -> Tensor:
        rows = action_rows(action, self.action_dim, num_rows=len(theta))
        return torch.cat([theta.float(), rows], 1)

"""The ratio of likelihood to marginal of an outcome, by parameters and action."""

from __future__ import annotations

from torch import Tensor

from sbi_active.inference.models.action_factor import ActionFactor
from sbi_active.inference.rounds.condition import action_rows, outcome_rows, pack

__all__ = ["ActionRatio"]


class ActionRatio(ActionFactor):
    r"""Learned log ratio :math:`\log p(x | \theta, \xi) / p(x | \xi)`.

    Its estimator is of theta and packed (x, action); p(x | action) belongs to its
    belief.
    """

    def log_ratio(self, theta: Tensor, x: Tensor, action: Tensor) -> Tensor:
        r"""Return :math:`\log r(\theta_i; x_i, \xi_i)` row by row, shape (n,).

        Args:
            theta: Shape (n, theta_dim).
            x: Shape (n, *x_shape); NaN throughout a row where there was no measurement.
            action: Shape (n, action_dim).
        """
        rows = outcome_rows(x, self.x_shape)
        action = action_rows(action, self.action_dim, num_rows=len(rows))
        return self.estimator(theta.float(), pack(rows, action)).reshape(-1)

    def log_factor(self, theta: Tensor, x: Tensor, action: Tensor) -> Tensor:
        """Return the log ratio, shape (n,): its marginal does not depend on theta."""
        return self.log_ratio(theta, x, action)

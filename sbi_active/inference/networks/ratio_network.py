"""Log ratio of likelihood to marginal: a regression's, corrected by a network."""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from attrs import field, frozen
from sbi.neural_nets.ratio_estimators import RatioEstimator
from torch import Tensor, nn

from sbi_active.expected import at_least, suggests
from sbi_active.inference.networks.conditioning import Whitening, can_regress, moments
from sbi_active.inference.networks.mixture_network import layers
from sbi_active.inference.networks.response import Response


@suggests
@frozen(kw_only=True, slots=False)
class RatioClassifier:
    """Settings of the classifier that gives the log ratio, and of its training.

    Attributes:
        hidden_features: Width of each hidden layer.
        num_iterations: Steps of stochastic gradient descent, at most.
    """

    hidden_features: tuple[int, ...] = field(default=(64, 64), validator=at_least(1))
    num_iterations: int = field(default=400, validator=at_least(1))
    anneal: ClassVar[bool] = False

    @property
    def training(self) -> dict[str, Any]:
        """Arguments of sbi's ``train``; its patience is sbi's own."""
        return {
            "training_batch_size": 200,
            "learning_rate": 2e-3,
            "stop_after_epochs": 20,
        }


class RatioNetwork(RatioEstimator):
    r"""Log ratio of a Gaussian regression, and what a network adds to it.

    .. math::
        \log r(\theta; x, \xi) = \log \mathcal N(x; f(\xi, \theta), S(\xi))
        - \log \mathcal N(x; \mu(\xi), S_0(\xi)) + g(\theta, x, \xi),

    both of a :class:`.Response`, the second of one to the action alone. A classifier
    alone learns ratios of a few nats; here it starts where the regression is. An
    outcome without a measurement has the ratio g.

    Args:
        settings: Layers of g.
        theta: Training parameters, shape (n, theta_dim).
        condition: Packed (x, action), shape (n, x_dim + action_dim); NaN throughout x
            where there was no measurement.
        action_dim: Numbers in an action.
    """

    def __init__(
        self,
        settings: RatioClassifier,
        theta: Tensor,
        condition: Tensor,
        action_dim: int,
    ) -> None:
        x_dim, dim = condition.shape[1] - action_dim, theta.shape[1]
        x, action = condition.double().split([x_dim, action_dim], 1)
        valid = x.isfinite().all(1)
        regresses = can_regress(valid, x_dim)
        width = dim + action_dim + x_dim * (2 if regresses else 1) + 1
        net = layers(width, settings.hidden_features, 1, nn.ReLU)
        super().__init__(net, theta.shape[1:], condition.shape[1:])
        self._x_dim = x_dim
        self.whiten = Whitening(theta, full=True)
        self.action_mean, self.action_scale = map(nn.Buffer, moments(action))
        self.y_mean, self.y_scale = map(nn.Buffer, moments(x[valid]))
        self.response: Response | None = None
        self.marginal: Response | None = None
        if regresses:
            y = (x[valid] - self.y_mean) / self.y_scale
            self.response = Response.best(self.whiten(theta[valid]), y, action[valid])
            self.marginal = Response.marginal(y, action[valid])

    def unnormalized_log_ratio(self, theta: Tensor, x: Tensor) -> Tensor:
        """Return log ratios of theta (..., d) and packed (x, action) (..., c)."""
        shape = self._get_shape_prefix(theta, x)
        rows = theta.reshape(-1, theta.shape[-1]), x.reshape(-1, x.shape[-1])
        return self._log_ratio(*rows).reshape(shape)

    def _log_ratio(
        self, theta: Tensor, condition: Tensor, *, far: float = 4.0
    ) -> Tensor:
        # Beyond so many deviations of the noise a residual is squashed.
        x, action = condition.double().tensor_split([self._x_dim], 1)
        valid = x.isfinite().all(1)
        y = (torch.where(valid[:, None], x, self.y_mean) - self.y_mean) / self.y_scale
        u = self.whiten(theta)
        base, outcome = torch.zeros_like(u[:, 0]), y
        if self.response is not None and self.marginal is not None:
            sharp, log_det = self.response.standardize(u, y, action)
            wide, log_det_wide = self.marginal.standardize(u[:, :1], y, action)
            base = log_det - log_det_wide
            base = base + 0.5 * (wide.square().sum(1) - sharp.square().sum(1))
            outcome = torch.cat([wide, far * torch.tanh(sharp / far)], 1)
        action = (action - self.action_mean) / self.action_scale
        seen = [u, action, outcome * valid[:, None], valid[:, None]]
        correction = self.net(torch.cat(seen, 1).float())[:, 0]
        return torch.where(valid, base, 0.0).float() + correction

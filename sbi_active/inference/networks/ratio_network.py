"""Log ratio of likelihood to marginal: a regression's, corrected by a network."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from sbi.neural_nets.ratio_estimators import RatioEstimator
from torch import Tensor, nn

from sbi_active.expected import require, require_least
from sbi_active.inference.networks.action_scaling import ActionScaling
from sbi_active.inference.networks.conditioning import Whitening, can_regress, scale_of
from sbi_active.inference.networks.response import Response


@dataclass(frozen=True, kw_only=True)
class RatioClassifier:
    """Settings of the classifier that gives the log ratio, and of its training.

    Attributes:
        hidden_features: Width of each hidden layer.
        batch_size: Rows a step.
        learning_rate: Learning rate of Adam.
        num_iterations: Steps of stochastic gradient descent, at most.
        stop_after_epochs: Epochs without improvement on held-out rows that end it.
    """

    hidden_features: tuple[int, ...] = (64, 64)
    batch_size: int = 200
    learning_rate: float = 2e-3
    num_iterations: int = 400
    stop_after_epochs: int = 20

    def __post_init__(self) -> None:
        names = ("hidden_features", "batch_size", "num_iterations", "stop_after_epochs")
        require_least(self, "raise it", **dict.fromkeys(names, 1))
        rate = self.learning_rate
        require(rate > 0, "learning_rate > 0", rate, "use 1e-3")


class RatioNetwork(RatioEstimator):
    r"""Log ratio of a Gaussian regression, and what a network adds to it.

    .. math::
        \log r(\theta; x, \xi) = \log \mathcal N(x; f(\xi, \theta), S(\xi))
        - \log \mathcal N(x; \mu(\xi), \sigma^2(\xi)) + g(\theta, x, \xi),

    with f and S of a :class:`.Response`, and the second
    density the outcome standardized given the action. A classifier alone learns ratios
    of a few nats; here it starts where the regression is. An outcome without a
    measurement has the ratio g.

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
        with_baseline = can_regress(valid, x_dim)
        width = dim + action_dim + x_dim * (2 if with_baseline else 1) + 1
        layers: list[nn.Module] = []
        for hidden in settings.hidden_features:
            layers += [nn.Linear(width, hidden), nn.ReLU()]
            width = hidden
        last = nn.Linear(width, 1)
        super().__init__(
            nn.Sequential(*layers, last), theta.shape[1:], condition.shape[1:]
        )
        with torch.no_grad():  # start at the regression's ratio
            last.weight.mul_(0.1)
            last.bias.zero_()
        self._x_dim = x_dim
        self.whiten = Whitening(theta, full=True)
        self.action_mean = nn.Buffer(action.mean(0))
        self.action_scale = nn.Buffer(scale_of(action))
        known = x[valid]
        enough = len(known) > 1
        self.y_mean = nn.Buffer(known.mean(0) if enough else torch.zeros(x_dim))
        self.y_scale = nn.Buffer(scale_of(known) if enough else torch.ones(x_dim))
        self.response: Response | None = None
        self.x_scaling: ActionScaling | None = None
        if with_baseline:
            y = (known - self.y_mean) / self.y_scale
            self.response = Response.best(self.whiten(theta[valid]), y, action[valid])
            self.x_scaling = ActionScaling(y, action[valid])

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
        seen = [u, (action - self.action_mean) / self.action_scale]
        base = torch.zeros(len(theta), dtype=torch.float64)
        if self.response is None or self.x_scaling is None:
            seen.append(y)
        else:
            location, scale = self.x_scaling.location_and_scale(action)
            wide = (y - location) / scale
            sharp, log_det = self.response.standardize(u, y, action)
            base = log_det + scale.log().sum(1)
            base = base + 0.5 * (wide.square().sum(1) - sharp.square().sum(1))
            seen += [wide, far * torch.tanh(sharp / far)]
        inside = torch.cat(seen[2:], 1) * valid[:, None]
        parts = torch.cat([*seen[:2], inside, valid[:, None].double()], 1)
        correction = self.net(parts.float())[:, 0]
        return torch.where(valid, base, 0.0).float() + correction

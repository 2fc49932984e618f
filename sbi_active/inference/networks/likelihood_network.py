"""Surrogate likelihood: a regression of the outcome and a mixture on its residual."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from sbi.neural_nets.estimators.base import ConditionalDensityEstimator
from torch import Tensor, nn
from torch.nn.functional import logsigmoid
from typing_extensions import override

from sbi_active.inference.networks.action_scaling import ActionScaling
from sbi_active.inference.networks.conditioning import (
    Whitening,
    can_regress,
    log_normal,
    scale_of,
)
from sbi_active.inference.networks.mixture_density import MixtureDensity
from sbi_active.inference.networks.mixture_network import log_prob_of_batch
from sbi_active.inference.networks.response import Response, exceeds_chance
from sbi_active.inference.sampling.adam import Adam


class ValidityNetwork(nn.Module):
    r"""Logistic regression on learned features, :math:`P(\text{valid} | \theta, \xi)`.

    Args:
        seen: Standardized inputs, shape (n, p).
        valid: Mask of the rows that gave a measurement, shape (n,), bool; both kinds
            occur.
        width: Width of the hidden layer.
        num_iterations: Number of steps of Adam over all rows at once.
        learning_rate: Learning rate, at which a weight moves by 3 at most.
        weight_decay: Weight decay; where few rows are invalid, the edge between stays
            soft.
    """

    def __init__(
        self,
        seen: Tensor,
        valid: Tensor,
        *,
        width: int = 32,
        num_iterations: int = 300,
        learning_rate: float = 0.01,
        weight_decay: float = 1e-3,
    ) -> None:
        super().__init__()
        self.net = nn.Sequential(
            nn.Linear(seen.shape[1], width), nn.Tanh(), nn.Linear(width, 1)
        )
        share = valid.double().mean().clamp(1e-3, 1 - 1e-3)
        with torch.no_grad():  # start at the share of valid rows
            last = self.net[-1]
            assert isinstance(last, nn.Linear)
            last.weight.mul_(0.1)
            last.bias.fill_(float(share.logit()))
        optimizer = Adam(self.parameters(), rate=learning_rate, decay=weight_decay)
        sign = valid.to(seen.dtype) * 2 - 1
        for _ in range(num_iterations):
            optimizer.forget_gradients()
            loss = -logsigmoid(sign * self.net(seen)[:, 0]).mean()
            loss.backward()
            optimizer.step()
        self.zero_grad(set_to_none=True)

    def forward(self, seen: Tensor) -> tuple[Tensor, Tensor]:
        """Return the log probabilities of a measurement and of none, each (n,)."""
        logit = self.net(seen)[:, 0]
        return logsigmoid(logit), logsigmoid(-logit)


class LikelihoodNetwork(ConditionalDensityEstimator):
    r"""Density of the outcome given parameters and action.

    .. math::
        q(x | \theta, \xi) = P_\text{valid}(\theta, \xi)\, |W(\xi)|\,
        m\big(W(\xi)\,(x - f(\xi, \theta)) \,\big|\, \theta, \xi\big)

    with f and the noise's whitener W from a
    :class:`.Response` and m a mixture density network on
    the residual, or the standard normal density where that predicts held-out rows as
    well: the network corrects the regression where that pays. An outcome of NaN has the
    probability :math:`1 - P_\text{valid}`. Without a regression, W and f standardize x
    given the action, or over all rows.

    Args:
        settings: Settings of the mixture; ``baseline`` and ``scaling`` are those of the
            outcome.
        x: Training outcomes, shape (n, x_dim); NaN throughout a row where there was no
            measurement.
        condition: Packed (theta, action), shape (n, theta_dim + action_dim).
        action_dim: Numbers in an action.

    Attributes:
        is_gaussian: Whether the residual's density is the standard normal one.
    """

    def __init__(
        self, settings: MixtureDensity, x: Tensor, condition: Tensor, action_dim: int
    ) -> None:
        super().__init__(nn.Identity(), x.shape[1:], condition.shape[1:])
        details = settings.details
        self._theta_dim = condition.shape[1] - action_dim
        theta, action = condition.double().split([self._theta_dim, action_dim], 1)
        valid = _valid(x)
        self.whiten = Whitening(theta, full=details.whiten)
        known = x[valid].double()
        if len(known) < 2:
            raise ValueError(
                f"expected at least two simulations with a measurement; got "
                f"{len(known)} of {len(x)}; check the simulator, or the belief"
            )
        self.y_mean = nn.Buffer(known.mean(0))
        self.y_scale = nn.Buffer(scale_of(known))
        y = (known - self.y_mean) / self.y_scale
        rows = self.whiten(theta[valid]), y, action[valid]

        self.response: Response | None = None
        self.x_scaling: ActionScaling | None = None
        few = not can_regress(valid, y.shape[1])
        if details.baseline == "best" and not few:
            self.response = Response.best(*rows)
        elif details.scaling == "action" and not few:
            self.x_scaling = ActionScaling(y, action[valid])
        z, _ = self._standardize(known, condition[valid])
        seen = self._see(condition)
        # The action's place matters to the scaling above alone.
        how = replace(details, scaling="global", whiten=False, baseline="none")
        plain = replace(settings, details=how)
        self.mixture = plain(z.float(), seen[valid])
        self.validity = None if bool(valid.all()) else ValidityNetwork(seen, valid)
        self._log_unseen = -math.log(len(x) + 2)
        self.is_gaussian = nn.Buffer(torch.tensor(False))

    @property
    @override
    def embedding_net(self) -> nn.Module:
        return nn.Identity()

    def residual_rows(self, x: Tensor, condition: Tensor) -> tuple[Tensor, Tensor]:
        """Return the training rows of the mixture: residuals and their conditions."""
        valid = _valid(x)
        with torch.no_grad():
            z, _ = self._standardize(x[valid].double(), condition[valid])
            return z.float(), self._see(condition[valid])

    def choose(self, residual: Tensor, seen: Tensor) -> None:
        """Take the standard normal density unless the mixture does better held out."""
        if self.response is None or not len(residual):
            return
        with torch.no_grad():
            gain = -self.mixture.loss(residual, seen) - log_normal(residual)
            self.is_gaussian.fill_(not exceeds_chance(gain.double()))

    def loss(self, input: Tensor, condition: Tensor, **kwargs: object) -> Tensor:
        """Return -log q, shape (n,), for rows (n, x_dim) and (n, condition_dim)."""
        return -self._log_density(input[None], condition)[0]

    def log_prob(self, input: Tensor, condition: Tensor, **kwargs: object) -> Tensor:
        """Return log q(input | condition), shape (sample_dim, batch_dim), float32.

        Args:
            input: Outcomes, shape (sample_dim, batch_dim, x_dim) or (batch_dim, x_dim).
            condition: Conditions, shape (batch_dim, condition_dim), or with the
                sample_dim too.
            kwargs: Arguments that are not used.
        """
        return log_prob_of_batch(self, self._log_density, input, condition)

    def sample(
        self, sample_shape: torch.Size, condition: Tensor, **kwargs: object
    ) -> Tensor:
        """Return draws, shape (*sample_shape, batch_dim, x_dim)."""
        self._check_condition_shape(condition)
        shape = torch.Size(sample_shape)
        seen = self._see(condition)
        if bool(self.is_gaussian):
            z = torch.randn(*shape, len(seen), *self.input_shape, device=seen.device)
        else:
            z = self.mixture.sample(shape, seen)
        mean, whitener = self._location_and_whitener(condition)
        step = torch.linalg.solve_triangular(
            whitener, z.double()[..., None], upper=False
        )
        x = (self.y_mean + self.y_scale * (mean + step[..., 0])).float()
        if self.validity is not None:
            probability = self.validity(seen)[0].exp().expand(x.shape[:-1])
            x[torch.rand(probability.shape) > probability] = torch.nan
        return x

    def _log_density(self, x: Tensor, condition: Tensor) -> Tensor:
        """Return log q, (s, n, x_dim) and (n, c) -> (s, n)."""
        valid = _valid(x)
        known = torch.where(valid[..., None], x.double(), self.y_mean)
        z, log_det = self._standardize(known, condition)
        z, seen = z.to(torch.float32), self._see(condition)
        if bool(self.is_gaussian):
            log_density = log_normal(z)
        else:
            log_density = self.mixture.log_prob(z, seen)
        log_density = log_density + log_det.to(log_density)
        if self.validity is None:
            # No row lacked a measurement: that it is rare says nothing of where.
            return torch.where(valid, log_density, self._log_unseen)
        log_valid, log_invalid = self.validity(seen)
        return torch.where(valid, log_valid + log_density, log_invalid)

    def _standardize(self, x: Tensor, condition: Tensor) -> tuple[Tensor, Tensor]:
        """Return residuals (..., n, x_dim) and log |dz / dx| (n,)."""
        mean, whitener = self._location_and_whitener(condition)
        y = (x - self.y_mean) / self.y_scale
        z = (whitener @ (y - mean)[..., None])[..., 0]
        log_det = whitener.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        return z, log_det - self.y_scale.log().sum()

    def _location_and_whitener(self, condition: Tensor) -> tuple[Tensor, Tensor]:
        theta, action = condition.double().tensor_split([self._theta_dim], 1)
        if self.response is not None:
            return self.response.mean_and_whitener(self.whiten(theta), action)
        if self.x_scaling is not None:
            mean, scale = self.x_scaling.location_and_scale(action)
            return mean, (1 / scale).diag_embed()
        mean = theta.new_zeros(len(theta), len(self.y_mean))
        return mean, torch.ones_like(mean).diag_embed()

    def _see(self, condition: Tensor) -> Tensor:
        """Return whitened parameters and the action, shape (n, c), float32."""
        theta, action = condition.double().tensor_split([self._theta_dim], 1)
        return torch.cat([self.whiten(theta), action], 1).float()


def _valid(x: Tensor) -> Tensor:
    return x.isfinite().all(-1)

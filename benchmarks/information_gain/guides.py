"""Variational families for pyro's estimators, one set of parameters an action."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor, nn
from torch.distributions import constraints

NUM_MARGINAL = 12  # components of the marginal's mixture
HIDDEN = 64  # units of the mixture's network


@dataclass(frozen=True)
class Pilot:
    """Simulations that standardize outcomes, and the regression of them.

    Attributes:
        center: Of x, shape (a, 1).
        scale: Of x, shape (a, 1).
        mean: Of theta, shape (d,).
        spread: Cholesky factor of the covariance of theta, shape (d, d).
        slope: Of theta on the standardized x, shape (a, d).
        factor: Cholesky factor of the residuals' covariance, shape (a, d, d).
        response: Slope of the standardized x on the whitened theta, shape (a, d), and
            the standard deviation of its residuals, shape (a, 1).
    """

    center: Tensor
    scale: Tensor
    mean: Tensor
    spread: Tensor
    slope: Tensor
    factor: Tensor
    response: tuple[Tensor, Tensor]

    @staticmethod
    def of(theta: Tensor, x: Tensor) -> Pilot:
        """Fit to parameters (n, d) and outcomes (a, n, 1) of every action at them."""
        theta, x = theta.double(), x.double()
        center, scale = x.mean(1), x.std(1)
        z = (x - center[:, None]) / scale[:, None]
        away = theta - theta.mean(0)
        slope = (z * away).mean(1) / z.square().mean(1)
        residual = away - z * slope[:, None]
        covariance = residual.mT @ residual / len(theta)
        factor = torch.linalg.cholesky(covariance)
        spread = torch.linalg.cholesky(torch.cov(theta.T))
        white = torch.linalg.solve_triangular(spread, away.T, upper=False).T
        response = torch.linalg.lstsq(white, z[..., 0].T).solution.T
        error = (z[..., 0] - response @ white.T).std(1, keepdim=True)
        parts = (center, scale, theta.mean(0), spread, slope, factor)
        return Pilot(
            *(part.float() for part in parts),
            response=(response.float(), error.float()),
        )


def posterior(
    pilot: Pilot, *, started: bool = False, num_components: int = 1
) -> Callable[..., None]:
    r"""Return :math:`q(\theta | x, \xi)`, Gaussians around a linear regression on x.

    With several components a network of (x, xi) shifts, scales and weights them.

    Args:
        pilot: Standardizes x.
        started: At the pilot's regression, else at the belief's mean and covariance.
        num_components: Of the mixture.
    """
    num_actions, d = pilot.slope.shape
    slope = pilot.slope if started else torch.zeros(num_actions, d)
    factor = pilot.factor if started else pilot.spread.expand(num_actions, d, d)
    network = _network(2, num_components * (1 + 2 * d)) if num_components > 1 else None

    def guide(y_dict: dict[str, Tensor], design: Tensor, *labels: object) -> None:
        z = (y_dict["x"] - pilot.center) / pilot.scale
        offset = pyro.param("offset", pilot.mean.expand(num_actions, d).clone())
        mean = offset + z * pyro.param("slope", slope.clone())
        scale = pyro.param(
            "factor", factor.clone(), constraint=constraints.lower_cholesky
        )
        if network is None:
            pyro.sample("theta", dist.MultivariateNormal(mean, scale_tril=scale))
            return
        pyro.module("network", network)
        out = network(torch.cat([z, design / 5], -1))
        logits, shift, log_scale = out.split(
            [num_components, num_components * d, num_components * d], -1
        )
        shape = (*z.shape[:-1], num_components, d)
        step = (scale[:, None] @ shift.reshape(*shape, 1))[..., 0]
        each = scale[:, None] * log_scale.reshape(*shape)[..., None, :].exp()
        components = dist.MultivariateNormal(mean[..., None, :] + step, scale_tril=each)
        weights = dist.Categorical(logits=logits)
        pyro.sample("theta", dist.MixtureSameFamily(weights, components))

    return guide


def marginal(pilot: Pilot) -> Callable[..., None]:
    r"""Return :math:`q(x | \xi)`, a mixture of Gaussians over the range of x."""
    num_actions = len(pilot.center)
    places = torch.linspace(-1.7, 1.7, NUM_MARGINAL).repeat(num_actions, 1)

    def guide(design: Tensor, *labels: object) -> None:
        place = pyro.param("place", places.clone())
        width = pyro.param(
            "width", torch.full_like(places, 0.3), constraint=constraints.positive
        )
        logits = pyro.param("logits", torch.zeros_like(places))
        components = dist.Normal(
            (pilot.center + pilot.scale * place)[..., None],
            (pilot.scale * width)[..., None],
        ).to_event(1)
        components = components.expand(torch.Size([*design.shape[:-1], NUM_MARGINAL]))
        weights = dist.Categorical(logits=logits.expand(*design.shape[:-1], -1))
        pyro.sample("x", dist.MixtureSameFamily(weights, components))

    return guide


def conditional(pilot: Pilot, *, started: bool = False) -> Callable[..., None]:
    r"""Return :math:`q(x | \theta, \xi)`, Gaussian around a linear regression.

    Args:
        pilot: Standardizes theta and x.
        started: At the pilot's regression, else at the marginal.
    """
    z, error = pilot.response
    start, log_sds = (z, error.log()) if started else (0 * z, 0 * error)

    def guide(theta_dict: dict[str, Tensor], design: Tensor, *labels: object) -> None:
        away = theta_dict["theta"] - pilot.mean
        white = torch.linalg.solve_triangular(
            pilot.spread, away[..., None], upper=False
        )[..., 0]
        weight = pyro.param("weight", start.clone())
        bias = pyro.param("bias", torch.zeros_like(log_sds))
        log_sd = pyro.param("log_sd", log_sds.clone())
        mean = bias + (weight * white).sum(-1, keepdim=True)
        normal = dist.Normal(
            pilot.center + pilot.scale * mean, pilot.scale * log_sd.exp()
        )
        pyro.sample("x", normal.to_event(1))

    return guide


def _network(num_in: int, num_out: int) -> nn.Module:
    last = nn.Linear(HIDDEN, num_out)
    nn.init.zeros_(last.weight)
    nn.init.normal_(last.bias, std=0.3)
    hidden = (nn.Linear(num_in, HIDDEN), nn.Tanh(), nn.Linear(HIDDEN, HIDDEN))
    return nn.Sequential(*hidden, nn.Tanh(), last)

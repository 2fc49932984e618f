"""Rounds of the numerical task as pyro's models, with their exact gains.

Variational families for pyro's estimators, one set of parameters an action.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor, nn
from torch.distributions import Distribution, constraints
from torch.distributions.constraints import real_vector

from benchmarks.information_gain.run import rounds
from sbi_active.tasks import Task

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


POOL = 200_000  # draws that stand in for the belief of round 2
NUM_PILOT = 1_000  # simulations an action that standardize the outcomes


class Pool(Distribution):
    """Draws in place of a distribution.

    Args:
        draws: Shape (m, theta_dim).
    """

    def __init__(self, draws: Tensor) -> None:
        super().__init__(torch.Size(), draws.shape[1:], validate_args=False)
        self.draws = draws

    @property
    def support(self) -> Any:
        return real_vector

    def sample(self, sample_shape: Any = ()) -> Tensor:
        return self.draws[torch.randint(len(self.draws), torch.Size(sample_shape))]


class Drawn(dist.TorchDistribution):
    """A belief as a site of pyro's model; no estimator here asks for its density."""

    def __init__(self, belief: Distribution, batch_shape: torch.Size) -> None:
        self.belief = belief
        super().__init__(batch_shape, belief.event_shape, validate_args=False)

    @property
    def support(self) -> Any:
        return real_vector

    def sample(self, sample_shape: Any = ()) -> Tensor:
        return self.belief.sample(torch.Size(sample_shape) + self.batch_shape)

    def log_prob(self, value: Tensor) -> Tensor:
        return torch.zeros(value.shape[:-1])


@dataclass(frozen=True)
class World:
    """One round of the task.

    Attributes:
        name: Of the round.
        task: With its actions.
        belief: To draw parameters from.
        entropy: Of the belief, exact, nats; pyro is told it.
        exact: Gains, shape (a,).
    """

    name: str
    task: Task
    belief: Distribution
    entropy: float
    exact: Tensor

    def model(self, design: Tensor) -> None:
        """Pyro's model; designs of shape (..., a, 1)."""
        theta = pyro.sample("theta", Drawn(self.belief, design.shape[:-1]))
        rows = theta.reshape(-1, 2), design.reshape(-1, 1)
        mean = self.task.simulator.mean(*rows).reshape(design.shape)
        pyro.sample("x", dist.Normal(mean, 1.0).to_event(1))

    def pilot(self) -> Pilot:
        """Return simulations that standardize outcomes."""
        theta = self.belief.sample(torch.Size([NUM_PILOT]))
        actions = self.task.actions.values
        x = [self.task.simulator(theta, a.expand(NUM_PILOT, -1)) for a in actions]
        return Pilot.of(theta, torch.stack(x))


def worlds() -> list[World]:
    """Return the cases."""
    cases = []
    for variant in ("linear", "sinh"):
        task, before, after = rounds(variant)
        gain = before.expected_information_gain(task.actions.values)
        name = f"{variant}, round 1"
        cases.append(World(name, task, task.prior, 2 * math.log(10), gain))
        if variant == "linear":
            draws = after.sample(POOL, seed=0)
            entropy = -float(after.log_prob(draws).mean())
            gain = after.expected_information_gain(task.actions.values)
            cases.append(
                World("linear, round 2", task, Pool(draws.float()), entropy, gain)
            )
    return cases

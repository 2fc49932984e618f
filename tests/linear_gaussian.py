"""A world with a closed form: x = action * theta + noise, theta ~ N(0, I)."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.distributions import Distribution, MultivariateNormal

from sbi_active import GaussianNoise
from sbi_active.design import Design
from sbi_active.design.estimators.base import CandidateSimulations

DIM = 2
PRIOR = MultivariateNormal(torch.zeros(DIM), torch.eye(DIM))


def simulator(theta: Tensor, action: Tensor) -> Tensor:
    return action * theta + torch.randn_like(theta)


def moments(x: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
    """Posterior mean and variance of each parameter."""
    variance = 1 / (1 + action**2)
    return variance * action * x, variance.expand_as(x)


def posterior(action: Tensor, x: Tensor) -> MultivariateNormal:
    """Posterior of trials, action (t, 1) and x (t, DIM)."""
    precision = 1 + action.square().sum()
    return MultivariateNormal(
        (action * x).sum(0) / precision, torch.eye(DIM) / precision
    )


def divergence(belief: Distribution, exact: Distribution) -> float:
    """KL(exact || belief) in nats; its standard error is about .02."""
    torch.manual_seed(0)
    theta = exact.sample(torch.Size([4_000]))
    return float((exact.log_prob(theta) - belief.log_prob(theta)).mean())


def information(action: Tensor) -> Tensor:
    """Exact information gain, (a, 1) -> (a,)."""
    return DIM * 0.5 * torch.log1p(action[:, 0] ** 2)


def candidates(action, num, *, noise=torch.randn_like, declared=None, pairs=False):
    """Return simulations of candidates, with the noise declared or in pairs."""
    torch.manual_seed(0)
    theta = PRIOR.sample((num,))
    mean = action[:, None] * theta
    x, again = (mean + noise(mean) for _ in "ab")
    if declared is not None:
        return CandidateSimulations(theta, action, x, mean, GaussianNoise(declared))
    return CandidateSimulations(theta, action, x, replicate=again if pairs else None)


def require_near(design: Design, exact: Tensor, bias: float = 1e-6) -> None:
    """Require gains within four of their standard errors, and a bias, of exact ones."""
    distance = (design.expected_information_gain - exact).abs()
    assert (distance < 4 * design.standard_error + bias).all()


class ExactModel:
    """The exact posterior as a model for the designer."""

    belief = PRIOR

    def __init__(self, spread: float = 1.0) -> None:
        self.spread = spread  # 1 is exact

    def log_posterior(self, theta: Tensor, x: Tensor, action: Tensor) -> Tensor:
        mean, variance = moments(x, action)
        z = (theta - mean) / (self.spread * variance.sqrt())
        scale = 0.5 * variance.log() + math.log(self.spread)
        return (-0.5 * z**2 - scale - 0.5 * math.log(2 * math.pi)).sum(-1)


class ExactLikelihood:
    """The likelihood as a model for the designer.

    Args:
        spread: Of the noise, 1 is exact.
    """

    belief = PRIOR

    def __init__(self, spread: float = 1.0) -> None:
        self.spread = spread
        self.exact_likelihood = spread == 1

    def log_likelihood(self, x: Tensor, theta: Tensor, action: Tensor) -> Tensor:
        return log_normal(x - action * theta, self.spread)


class ExactLikelihoodAndPosterior(ExactLikelihood, ExactModel):
    """Both."""


class ExactRatio:
    """The ratio of likelihood to marginal as a model for the designer.

    Args:
        offset: What it is off by, a function of x as its normalization may be.
        power: To which it is raised; 1 is exact.
    """

    belief = PRIOR

    def __init__(self, offset: float = 0.0, power: float = 1.0) -> None:
        self.offset, self.power = offset, power

    def log_ratio(self, theta: Tensor, x: Tensor, action: Tensor) -> Tensor:
        marginal = log_normal(x, (1 + action**2).sqrt())
        ratio = log_normal(x - action * theta, 1.0) - marginal
        return self.power * ratio + self.offset * x.abs().sum(-1)


def log_normal(z: Tensor, sd: float | Tensor) -> Tensor:
    """Log density of independent normal numbers, (n, d) -> (n,)."""
    scale = torch.as_tensor(sd)
    return (-0.5 * (z / scale) ** 2 - scale.log() - 0.5 * math.log(2 * math.pi)).sum(-1)

"""A world whose outcomes are a measurement or none: theta ~ N(0, 1), exact gains.

A push of strength a gives x = a theta + N(0, 1), or nothing with a probability that
grows with the strength and depends on theta; its information is known by enumeration of
validity and quadrature over theta and x.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor
from torch.distributions import MultivariateNormal

from sbi_active.design.estimators.base import CandidateSimulations
from sbi_active.simulation import GaussianNoise

PRIOR = MultivariateNormal(torch.zeros(1), torch.eye(1))
ACTIONS = torch.tensor([[0.5], [1.0], [2.0], [8.0]])
GRID = -5.985 + 0.03 * torch.arange(400).double()  # no point at an edge of validity
WEIGHT = torch.softmax(-0.5 * GRID**2, 0)  # of the prior on the grid
NOISE = GaussianNoise(1.0)


@dataclass(frozen=True)
class Fragile:
    """Pushes that fail.

    Attributes:
        luck: 0 for validity that is a function of theta; the width of the logistic
            otherwise.
    """

    luck: float

    def log_valid(self, theta: Tensor, action: Tensor) -> Tensor:
        """Log probability of a measurement; strong pushes need a large theta."""
        margin = theta - 0.3 * (action - 2)
        if self.luck == 0:
            return torch.where(margin > 0, 0.0, -torch.inf).to(theta)
        return torch.nn.functional.logsigmoid(margin / self.luck)

    def mean(self, theta: Tensor, action: Tensor) -> Tensor:
        """Noise-free outcome, NaN where there is none."""
        lost = torch.rand_like(theta).log() > self.log_valid(theta, action)
        return torch.where(lost, torch.nan, action * theta)

    def __call__(self, theta: Tensor, action: Tensor) -> Tensor:
        """Return outcomes, shape (n, 1)."""
        mean = self.mean(theta, action)
        return mean + torch.randn_like(mean)

    def simulations(self, num_samples: int, seed: int) -> CandidateSimulations:
        """Return declared simulations without luck, replicated ones with it."""
        torch.manual_seed(seed)
        theta = PRIOR.sample((num_samples,))
        action = ACTIONS[:, None].expand(-1, num_samples, 1)
        rows = theta.expand(action.shape), action
        if self.luck == 0:
            mean = self.mean(*rows)
            x = mean + torch.randn_like(theta)
            return CandidateSimulations(theta, ACTIONS, x, mean, NOISE)
        return CandidateSimulations(theta, ACTIONS, self(*rows), replicate=self(*rows))

    @cache  # noqa: B019, three worlds live as long as the tests
    def exact(self) -> dict[str, Tensor]:
        """Return exact gains in nats, each of shape (a,).

        "counted" is the information of all outcomes; "validity" that of validity alone;
        "dropped" the mean of log p(theta | x) - log p(theta) over measurements, which
        forgets the others.
        """
        result: dict[str, list[float]] = {"counted": [], "validity": [], "dropped": []}
        x = torch.linspace(-50, 50, 2_501).double()
        for a in ACTIONS[:, 0].double():
            log_v = self.log_valid(GRID, a)
            p = log_v.exp()
            valid = (WEIGHT * p).sum()
            known = torch.special.xlogy(p, p / valid)
            known += torch.special.xlogy(1 - p, (1 - p) / (1 - valid))
            validity = WEIGHT @ known
            log_x = -0.5 * (x[:, None] - a * GRID) ** 2 - 0.5 * math.log(2 * math.pi)
            # E over measurements of log p(x | theta) - log p(x | valid)
            joint = WEIGHT * p / valid
            density = log_x.exp() @ joint
            entropy = -torch.special.xlogy(density, density).sum() * (x[1] - x[0])
            conditional = entropy - 0.5 * (math.log(2 * math.pi) + 1)
            tilt = joint @ torch.where(joint > 0, log_v - valid.log(), 0.0)
            result["counted"].append(float(validity + valid * conditional))
            result["validity"].append(float(validity))
            result["dropped"].append(float(conditional + tilt))
        return {name: torch.tensor(v).double() for name, v in result.items()}

    def log_posterior(self, theta: Tensor, x: Tensor, action: Tensor) -> Tensor:
        """Exact log density given a measurement or none, as a network's."""
        theta, x, action = theta.double(), x.double(), action.double()

        def log_joint(t: Tensor) -> Tensor:
            log_v = self.log_valid(t, action)
            lost = torch.log1p(-log_v.exp().clamp_max(1 - 1e-12))
            measured = log_v + log_normal(x - action * t)
            return torch.where(x.isnan(), lost, measured) + log_normal(t)

        step = float(GRID[1] - GRID[0])
        evidence = log_joint(GRID.expand(len(x), -1)).logsumexp(1) + math.log(step)
        return log_joint(theta)[:, 0] - evidence


def log_normal(z: Tensor) -> Tensor:
    """Standard normal log density."""
    return -0.5 * z**2 - 0.5 * math.log(2 * math.pi)

"""Information about some of the parameters, against the linear-Gaussian closed form.

The estimate is a lower bound: it may not exceed the exact value by more than three
standard errors, and must reach it within .15 nat.
"""

import math

import pytest
import torch
from sbi.utils import BoxUniform
from torch.distributions import MultivariateNormal

from sbi_active.design.estimators.base import CandidateSimulations
from sbi_active.design.estimators.posterior import ParameterGain

COVARIANCE = torch.tensor([[1.0, 0.6, 0.0], [0.6, 1.0, 0.0], [0.0, 0.0, 1.0]])
BELIEF = MultivariateNormal(torch.zeros(3), COVARIANCE)
MIX = torch.tensor([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5]])  # x = a MIX theta + N(0, I)
ACTIONS = torch.tensor([[0.0], [0.5], [2.0], [20.0]])
SLACK = 0.15


def simulations(n=400, seed=0):
    torch.manual_seed(seed)
    theta = BELIEF.sample((n,))
    x = ACTIONS[:, None] * (theta @ MIX.T) + torch.randn(len(ACTIONS), n, 2)
    return CandidateSimulations(theta, ACTIONS, x)


def information(index):
    gains = []
    for a in ACTIONS[:, 0]:
        spread = a**2 * MIX @ COVARIANCE @ MIX.T + torch.eye(2)
        cross = a * COVARIANCE[index] @ MIX.T
        prior = COVARIANCE[index][:, index]
        posterior = prior - cross @ torch.linalg.solve(spread, cross.T)
        gains.append(0.5 * (torch.logdet(prior) - torch.logdet(posterior)))
    return torch.stack(gains).double()


def assert_lower_bound(gain, exact, slack=SLACK):
    error = gain.std(1) / gain.shape[1] ** 0.5
    margin = 3 * error + 0.01  # of the marginal's entropy
    assert (gain.mean(1) < exact + margin).all()
    assert (gain.mean(1) > exact - slack - 3 * error).all()


@pytest.mark.parametrize("index", [[0], [0, 1]])
def test_the_closed_form(index):
    gain = ParameterGain(lambda t: t[:, index])(None, simulations(), BELIEF)
    exact = information(index)
    assert_lower_bound(gain, exact)
    mean = gain.mean(1)
    assert abs(float(mean[0])) < 0.05
    assert mean.argsort().tolist() == exact.argsort().tolist()


def test_a_bounded_belief_and_a_curve():
    """x = theta_1^2 + noise under a uniform belief, by quadrature; theta_2 is idle."""
    torch.manual_seed(0)
    belief = BoxUniform(-torch.ones(2), torch.ones(2))
    theta = belief.sample((800,))
    sd = 0.05
    x = (theta[:, :1] ** 2 + sd * torch.randn(800, 1))[None]
    rows = CandidateSimulations(theta, torch.zeros(1, 1), x)
    grid = torch.linspace(-1, 1, 2_001).double()
    outcome = torch.linspace(-0.4, 1.4, 3_001).double()
    density = torch.distributions.Normal(grid**2, sd).log_prob(outcome[:, None])
    density = density.exp().mean(1)
    entropy = -torch.special.xlogy(density, density).sum() * 0.0006
    exact = entropy - 0.5 * (math.log(2 * math.pi) + 1) - math.log(sd)
    # two modes, +- the root: a mixture is needed
    gain = ParameterGain(lambda t: t[:, :1])(None, rows, belief)
    assert_lower_bound(gain, exact[None], 0.25)
    idle = ParameterGain(lambda t: t[:, 1:])(None, rows, belief).mean()
    assert abs(float(idle)) < 0.05

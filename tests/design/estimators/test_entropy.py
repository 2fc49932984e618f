"""Entropy differences against closed forms.

Nearest neighbors have a bias of order (k / n)^(2 / d) at the edges of the density;
tolerances are four standard errors and the stated bound of it.
"""

import pytest
import torch

from sbi_active.design import EntropyGain
from sbi_active.design.estimators.base import CandidateSimulations
from sbi_active.simulation import GaussianNoise
from tests.linear_gaussian import PRIOR, information

BIAS = 0.06  # bound for d = 2 and n = 2000, k = 4, under gains up to 1.6 nats
ACTIONS = torch.tensor([[0.0], [0.5], [1.0], [2.0]])


def declared(n=2_000, actions=ACTIONS, declared_sd=1.0):
    torch.manual_seed(0)
    theta = PRIOR.sample((n,))
    mean = actions[:, None] * theta
    x = mean + torch.randn_like(theta)
    return CandidateSimulations(theta, actions, x, mean, GaussianNoise(declared_sd))


def replicated(noise=torch.randn_like):
    torch.manual_seed(0)
    theta = PRIOR.sample((2_000,))
    rows = theta.expand(4, -1, -1)
    x, again = (ACTIONS[:, None] * theta + noise(rows) for _ in "ab")
    return CandidateSimulations(theta, ACTIONS, x, replicate=again)


def distance(simulations, exact):
    gain = EntropyGain()(None, simulations, PRIOR)
    error = gain.std(1) / gain.shape[1] ** 0.5
    return (gain.mean(1) - exact).abs() - 4 * error


@pytest.mark.parametrize("simulations", [declared, replicated])
def test_the_closed_form(simulations):
    assert (distance(simulations(), information(ACTIONS)) < BIAS).all()


def test_a_wrong_declaration_is_wrong():
    """Negative control: half the noise doubles what x seems to tell."""
    wrong = distance(declared(declared_sd=0.5), information(ACTIONS))
    assert (wrong > BIAS).all()


def test_scales_and_correlation_do_not_matter():
    rows = declared()
    assert rows.mean is not None
    turn = torch.tensor([[1e4, 0.0], [9e3, 1e-2]])
    again = rows.mean + torch.randn_like(rows.x)
    parts = {"x": rows.x @ turn, "mean": rows.mean @ turn, "replicate": again @ turn}
    turned = CandidateSimulations(rows.theta, rows.action, **parts)
    assert (distance(turned, information(ACTIONS)) < BIAS).all()


def test_large_information_does_not_saturate():
    actions = torch.tensor([[1e3], [1e4]])  # 13.8 and 18.4 nats
    assert (distance(declared(actions=actions), information(actions)) < BIAS).all()


def two_sided(theta):
    return torch.distributions.Laplace(0.0, 1.0).sample(theta.shape)


def varying(theta):
    return torch.exp(0.3 * theta) * torch.randn_like(theta)


@pytest.mark.parametrize("noise", [two_sided, varying])
def test_noise_that_is_not_gaussian_is_noticed(noise):
    assert EntropyGain().problems(replicated()) == []
    assert EntropyGain().problems(declared()) == []
    (problem,) = EntropyGain().problems(replicated(noise=noise))
    assert problem.startswith("noise is not Gaussian")

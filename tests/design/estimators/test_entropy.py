"""Entropy differences against closed forms.

Nearest neighbors have a bias of order (k / n)^(2 / d) at the edges of the density;
tolerances are four standard errors and the stated bound of it.
"""

import math

import pytest
import torch

from sbi_active.design import EntropyGain
from sbi_active.design.estimators.base import CandidateSimulations
from sbi_active.simulation import GaussianNoise
from tests.linear_gaussian import PRIOR, information

BIAS = 0.06  # bound for d = 2 and n = 2000, k = 4, under gains up to 1.6 nats
ACTIONS = torch.tensor([[0.0], [0.5], [1.0], [2.0]])


def declared(n=2_000, seed=0, actions=ACTIONS, sd=1.0, declared_sd=1.0):
    torch.manual_seed(seed)
    theta = PRIOR.sample((n,))
    mean = actions[:, None] * theta
    x = mean + sd * torch.randn_like(theta)
    return CandidateSimulations(theta, actions, x, mean, GaussianNoise(declared_sd))


def replicated(n=2_000, seed=0, noise=torch.randn_like):
    torch.manual_seed(seed)
    theta = PRIOR.sample((n,))
    x, again = (ACTIONS[:, None] * theta + noise(theta.expand(4, n, 2)) for _ in "ab")
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
    turned = CandidateSimulations(
        rows.theta,
        rows.action,
        rows.x @ turn,
        rows.mean @ turn,
        replicate=(rows.mean + torch.randn_like(rows.x)) @ turn,
    )
    assert (distance(turned, information(ACTIONS)) < BIAS).all()


def test_large_information_does_not_saturate():
    actions = torch.tensor([[1e3], [1e4]])  # 13.8 and 18.4 nats
    assert (distance(declared(actions=actions), information(actions)) < BIAS).all()


def test_noise_whose_scale_depends_on_the_parameters():
    """x = e, sd = exp(theta / 2): entropy of x from its exact scale mixture."""
    torch.manual_seed(0)
    theta = torch.randn(4_000, 1)
    x, again = ((theta / 2).exp() * torch.randn(1, 4_000, 1) for _ in "ab")
    rows = CandidateSimulations(theta, torch.zeros(1, 1), x, replicate=again)
    assert EntropyGain().problems(rows) == []
    grid, t = torch.linspace(-60, 60, 24_001).double(), torch.linspace(-6, 6, 241)
    t = t.double()
    weight = torch.softmax(-0.5 * t**2, 0)
    density = torch.distributions.Normal(0, (t / 2).exp()).log_prob(grid[:, None])
    density = density.exp() @ weight
    entropy = -(density * density.clamp_min(1e-300).log()).sum() * (grid[1] - grid[0])
    exact = entropy - 0.5 * (math.log(2 * math.pi) + 1)  # E log sd = 0
    gain = EntropyGain()(None, rows, PRIOR)
    error = float(gain.std() / 4_000**0.5)
    assert float(gain.mean()) == pytest.approx(float(exact), abs=4 * error + 0.02)


def test_noise_that_is_not_gaussian_is_noticed():
    def two_sided(like):
        return torch.distributions.Laplace(0.0, 1.0).sample(like.shape)

    assert EntropyGain().problems(replicated()) == []
    assert EntropyGain().problems(declared()) == []
    (problem,) = EntropyGain().problems(replicated(noise=two_sided))
    assert problem.startswith("noise is not Gaussian")


@pytest.mark.parametrize("simulations", [declared, replicated])
def test_missing_outcomes_count(simulations):
    """No measurement where theta_1 > 0: log 2, and half of what the others tell."""
    rows = simulations()
    lost = (rows.theta[:, 0] > 0)[None, :, None]

    def lose(part):
        return None if part is None else torch.where(lost, torch.nan, part)

    missing = CandidateSimulations(
        rows.theta, ACTIONS, lose(rows.x), lose(rows.mean), rows.noise,
        lose(rows.replicate),
    )  # fmt: skip
    # theta_1 < 0 is a half normal: x_1's entropy by quadrature
    exact = []
    for a in ACTIONS[:, 0].tolist():
        grid = torch.linspace(-14, 8, 4_001).double()
        s = (1 + a**2) ** 0.5
        unit = torch.distributions.Normal(0.0, 1.0)
        density = 2 / s * (unit.log_prob(grid / s)).exp() * unit.cdf(-a * grid / s)
        entropy = -(density * density.clamp_min(1e-300).log()).sum() * 0.0055
        first = float(entropy) - 0.5 * (math.log(2 * math.pi) + 1)
        exact.append(math.log(2) + 0.5 * (first + math.log(s)))
    assert (distance(missing, torch.tensor(exact)) < BIAS).all()


def test_outcomes_that_are_always_missing_tell_nothing():
    rows = declared(n=50)
    nan = torch.full_like(rows.x, torch.nan)
    lost = CandidateSimulations(rows.theta, ACTIONS, nan, nan, rows.noise)
    assert (EntropyGain()(None, lost, PRIOR) == 0).all()

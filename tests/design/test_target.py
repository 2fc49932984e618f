"""What an action tells about a function of the parameters, or about some of them.

The estimate is a lower bound: it may not exceed the exact value by more than three
standard errors, and must reach it within .15 nat.
"""

import math

import pytest
import torch
from sbi.utils import BoxUniform
from torch.distributions import MultivariateNormal

from sbi_active import DiscreteActions, InformationGainDesigner
from sbi_active.criticism.effects.augmented import AugmentedSimulator
from sbi_active.design.estimators.base import CandidateSimulations
from sbi_active.design.estimators.posterior import ParameterGain
from sbi_active.simulation import SimulatorModel
from tests.effects import added
from tests.linear_gaussian import PRIOR

SIDES = DiscreteActions([0.0, 1.0], names=["side"])
ONE = MultivariateNormal(torch.zeros(1), torch.eye(1))


def one_at_a_time(theta, action):
    """The first action tells about the first parameter, the second the other."""
    gain = torch.tensor([8.0, 2.0])
    both = torch.where(action > 0.5, gain * theta, gain.flip(0) * theta)
    return both.gather(1, (action > 0.5).long())


NAMES = ["mass", "friction"]
MODEL = SimulatorModel(one_at_a_time, noise=1.0, parameter_names=NAMES)


def select(target, *, model=MODEL, belief=PRIOR, **options):
    designer = InformationGainDesigner(SIDES, num_samples=400, **options)
    return designer.select(None, model, belief=belief, target=target, seed=0)


@pytest.mark.parametrize(
    ("estimator", "name", "place"), [("auto", "mass", 0), ("linear", "friction", 1)]
)
def test_a_linear_function_of_a_parameter_is_the_parameter(estimator, name, place):
    by_name = select(name, estimator=estimator)
    by_value = select(lambda theta: 1 - 3 * theta[:, place], estimator=estimator)
    assert by_value.action.tolist() == by_name.action.tolist() == [float(place)]
    assert by_value.estimator == by_name.estimator
    gains = by_value.expected_information_gain, by_name.expected_information_gain
    most = 1e-6 if estimator == "linear" else 0.03  # of the marginal's entropy
    torch.testing.assert_close(*gains, rtol=0, atol=most)


def test_a_function_of_an_effect():
    model = AugmentedSimulator(MODEL, [added("drag", lambda action: 6 * action)])
    belief = MultivariateNormal(torch.zeros(3), torch.eye(3))
    seen = []

    def loss(theta, effect):
        seen.append((theta.shape[1], [*effect], effect["drag"].shape[1]))
        return effect["drag"][:, 0] + 0.0 * theta[:, 0]

    design = select(loss, model=model, belief=belief)
    assert design.action.tolist() == [1.0]
    assert all(each == (2, ["drag"], 1) for each in seen)
    plain = select(lambda theta: theta[:, 2], model=model, belief=belief)
    gain = design.expected_information_gain
    assert torch.equal(plain.expected_information_gain, gain)


def test_a_failure_or_none():
    """The sign of theta: log 2 at most, and next to nothing from a weak action."""
    model = SimulatorModel(lambda t, a: a * t, noise=1.0)
    designer = InformationGainDesigner([0.1, 100.0], num_samples=1_500)
    given = {"belief": ONE, "target": lambda theta: (theta[:, 0] > 0).float()}
    design = designer.select(None, model, **given, seed=0)
    weak, strong = design.expected_information_gain.tolist()
    assert abs(weak) < 0.05
    error = float(design.standard_error[1])
    assert math.log(2) - 0.3 - 3 * error < strong < math.log(2) + 3 * error
    assert strong > 3 * error


# Information about some of the parameters: a lower bound of the closed form


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

"""What an action tells about a function of the parameters."""

import math

import pytest
import torch
from torch.distributions import MultivariateNormal

from sbi_active import DiscreteActions, GaussianNoise, InformationGainDesigner
from sbi_active.criticism.effects.augmented import AugmentedSimulator
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
MODEL = SimulatorModel(one_at_a_time, noise=GaussianNoise(1.0), parameter_names=NAMES)


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
    model = SimulatorModel(lambda t, a: a * t, noise=GaussianNoise(1.0))
    designer = InformationGainDesigner(DiscreteActions([0.1, 100.0]), num_samples=1_500)
    given = {"belief": ONE, "target": lambda theta: (theta[:, 0] > 0).float()}
    design = designer.select(None, model, **given, seed=0)
    weak, strong = design.expected_information_gain.tolist()
    assert abs(weak) < 0.05
    error = float(design.standard_error[1])
    assert math.log(2) - 0.3 - 3 * error < strong < math.log(2) + 3 * error
    assert strong > 3 * error

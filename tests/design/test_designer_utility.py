"""Costs, constraints, exclusion, chance and given simulations."""

import pytest
import torch

from sbi_active import (
    BoxActions,
    DiscreteActions,
    GaussianNoise,
    InformationGainDesigner,
    MixedActions,
    RandomDesigner,
    SimulatorModel,
)
from sbi_active.simulation import Simulations
from tests.design.test_designer import ACTIONS, VALUES
from tests.linear_gaussian import PRIOR, ExactModel, information, simulator

MODEL = SimulatorModel(lambda theta, action: action * theta, noise=GaussianNoise(1.0))
BOX = BoxActions(0.0, 2.0, names=["push"], units=["m/s"])


def select(actions=ACTIONS, num_samples=1_000, **options):
    designer = InformationGainDesigner(actions, num_samples=num_samples)
    options = {"seed": 0} | options
    return designer.select(None, MODEL, belief=PRIOR, **options)


def dear(action):
    """A cost that makes an action of about 1.4 the best a unit of cost."""
    return 1 + action[:, 0] ** 3 / 4


def test_information_by_cost():
    design = select(cost=dear)
    assert design.action.tolist() == [1.0]  # log 2 / 1.25 against log 5 / 3
    assert torch.allclose(design.cost, dear(VALUES[:, None]).double())
    ratio = design.expected_information_gain / design.cost
    assert torch.equal(design.utility, ratio)
    exact = information(VALUES[:, None])
    distance = (design.expected_information_gain - exact).abs()
    assert (distance < 4 * design.standard_error + 0.05).all()
    assert design.probability_best[2] > 0.9
    free = select()
    assert free.action.tolist() == [2.0]  # negative control
    assert free.cost is None
    assert torch.equal(free.utility, free.expected_information_gain)
    with pytest.raises(ValueError, match=r"expected positive costs of shape \(4,\)"):
        select(cost=lambda action: -action[:, 0])


def test_a_constraint():
    design = select(constraint=lambda action: action[:, 0] < 1.5)
    assert design.action.tolist() == [1.0]
    assert design.candidates[:, 0].tolist() == [0.0, 0.5, 1.0]
    assert design.num_simulations == int(design.num_samples.sum())
    assert "1 of 4 candidates not permitted" in design.notes
    with pytest.raises(ValueError, match="expected a permitted action; got none of 4"):
        select(constraint=lambda action: action[:, 0] < 0)
    with pytest.raises(ValueError, match=r"expected a constraint that maps actions"):
        select(constraint=lambda action: action > 0)


def test_a_constraint_in_a_box():
    design = select(BOX, 150, constraint=lambda action: action[:, 0] < 1.5)
    assert 1.3 < float(design.action) < 1.5


def rows(num, actions, seed=0):
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        theta, action = PRIOR.sample((num,)), actions.sample((num,))
        return Simulations(theta, action, simulator(theta, action))


@pytest.mark.parametrize("estimator", ["auto", "posterior"])
def test_given_simulations_need_no_others(estimator):
    designer = InformationGainDesigner(ACTIONS, estimator=estimator)

    def never(theta, action):
        raise AssertionError("nothing is to be simulated")

    given = rows(4_000, ACTIONS)
    design = designer.select(ExactModel(), never, simulations=given, seed=0)
    assert design.action.tolist() == [2.0]
    assert design.num_simulations == 0
    assert int(design.num_samples.sum()) == 4_000
    assert (design.estimator, design.bound) == ("PosteriorGain", "none")
    assert design.stopped == "simulations given"
    assert "too high where the model was trained on them" in design.notes[0]
    exact = information(VALUES[:, None])
    distance = (design.expected_information_gain - exact).abs()
    assert (distance < 4 * design.standard_error + 1e-6).all()
    dearer = lambda action: 1 + action[:, 0] ** 3  # noqa: E731, .35 against .18
    again = designer.select(ExactModel(), simulations=given, seed=0, cost=dearer)
    assert again.action.tolist() == [1.0]


def test_given_simulations_are_of_a_list():
    with pytest.raises(TypeError, match="expected a list of actions"):
        InformationGainDesigner(BOX).select(ExactModel(), simulations=rows(64, BOX))


def test_random_choices_of_any_space():
    mixed = MixedActions(BOX, DiscreteActions([0.0, 1.0]))
    drawn = [RandomDesigner(mixed).select(seed=s).action for s in range(20)]
    assert mixed.contains(torch.stack(drawn)).all()
    assert [len({float(a[k]) for a in drawn}) for k in range(2)] == [20, 2]
    design = RandomDesigner(mixed).select(seed=0, constraint=lambda a: a[:, 0] > 1.5)
    assert float(design.action[0]) > 1.5
    with pytest.raises(ValueError, match="permits a part of BoxActions"):
        RandomDesigner(BOX).select(seed=0, constraint=lambda a: a[:, 0] > 3)

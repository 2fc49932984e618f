"""Designs in continuous and mixed spaces."""

import pytest
import torch
from sbi.utils import BoxUniform
from torch.distributions import MultivariateNormal

from sbi_active.actions import BoxActions, DiscreteActions, MixedActions
from sbi_active.design import GradientSearch, InformationGainDesigner, Search
from sbi_active.design.search import Evaluations, Objective
from sbi_active.simulation import GaussianNoise, SimulatorModel
from sbi_active.tasks.numerical.task import NumericalTask
from tests.design.test_designer import Exact
from tests.linear_gaussian import PRIOR, ExactModel, require_near, simulator

BOX = BoxActions(-5.0, 5.0, names=["xi"])


def test_regret_on_the_numerical_task():
    task = NumericalTask()
    action = torch.full((1, 1), -5.0)
    x = task.simulator.mean(task.theta_true[None], action)
    posterior = task.reference(action, x)
    given = {"belief": Exact(posterior), "seed": 0}
    design = InformationGainDesigner(BOX).select(None, task.simulator, **given)
    exact = posterior.expected_information_gain(torch.linspace(-5, 5, 101))
    own = posterior.expected_information_gain(design.candidates)
    assert float(exact.max() - own[design.index]) <= 0.05
    assert design.num_simulations <= 0.2 * 75_000  # a grid of 101 takes as many
    require_near(design, own, 0.05)
    assert design.labels == ("xi",)


def test_which_search():
    lists = MixedActions(DiscreteActions([1.0, 2.0]), DiscreteActions([0.0, 1.0]))
    designer = InformationGainDesigner(lists, num_samples=100)
    model = SimulatorModel(lambda t, a: a[:, :1] * t, noise=1.0)
    design = designer.select(None, model, belief=PRIOR, seed=0)
    assert design.candidates.shape == (4, 2)
    assert float(design.action[0]) == 2.0
    with pytest.warns(DeprecationWarning, match='use search="gradient"'):
        designer = InformationGainDesigner(BOX, search="bayesopt")
    assert isinstance(designer.search, GradientSearch)
    with pytest.raises(ValueError, match="expected search among 'auto', 'gradient'"):
        InformationGainDesigner(BOX, search="grid")
    with pytest.raises(ValueError, match="expected a budget >= "):
        InformationGainDesigner(BOX).select(ExactModel(), simulator, budget=500, seed=0)


class Twice(Search):
    """A search of one's own, which evaluates the same actions twice."""

    def size(self, actions):
        return 4

    def num_evaluations(self, budget, num_samples):
        return 4

    def finalists(self, objective):
        action = torch.tensor([[1.0], [2.0]])
        self.found = [objective.evaluate(action) for _ in range(2)]
        return action


def test_evaluations_share_parameters_and_noise_from_call_to_call():
    search = Twice()
    model = SimulatorModel(lambda t, a: a * t[:, :1], noise=1.0)
    designer = InformationGainDesigner(BOX, search=search, num_samples=200)
    design = designer.select(None, model, belief=PRIOR, seed=0)
    first, second = search.found
    assert torch.equal(first.utility, second.utility)
    assert design.candidates[:, 0].tolist() == [1.0, 2.0]
    # what compares and reports is fresh
    assert not torch.equal(first.utility, design.expected_information_gain)
    assert design.num_simulations == int(design.num_samples.sum()) + 4 * 20


def test_slopes_in_a_search_leave_its_finalists_simulations():
    prior = MultivariateNormal(torch.zeros(4), torch.eye(4))
    weight = torch.randn(4, 9, generator=torch.Generator().manual_seed(0))

    def swing(theta, action):
        return 2 * torch.sin(3 * action[:, :1] * (theta @ weight))

    model = SimulatorModel(swing, noise=0.05)
    designer = InformationGainDesigner(BOX, num_samples=64, estimator="nested")
    design = designer.select(None, model, belief=prior, seed=0)
    assert design.expected_information_gain.isfinite().all()
    assert int(design.num_samples.min()) >= 8


def test_a_search_for_a_parameter_sees_it_by_few_simulations():
    def bump(theta, action):
        strength = torch.exp(-8 * (action[:, :1] - 0.7) ** 2)
        return torch.cat([theta[:, :1] * strength, theta[:, 1:] * action[:, 1:]], 1)

    noise, names = GaussianNoise(0.1), ("bump", "slope")
    model = SimulatorModel(bump, noise=noise, parameter_names=names)
    prior = BoxUniform(torch.zeros(2), torch.ones(2))
    square = BoxActions([0.0, 0.0], [1.0, 1.0])
    designer = InformationGainDesigner(square, num_samples=64)
    design = designer.select(None, model, belief=prior, target="bump", seed=0)
    assert abs(float(design.action[0]) - 0.7) < 0.15
    assert float(design.expected_information_gain.max()) > 0.3
    assert design.notes == ()


def test_an_estimate_by_too_few_outcomes_is_said_to_be_one():
    model = SimulatorModel(simulator, parameter_names=("a", "b"))
    designer = InformationGainDesigner([1.0, 2.0], num_samples=16)
    design = designer.select(None, model, belief=PRIOR, target="a", seed=0)
    assert any("outcomes of an action; raise num_samples" in n for n in design.notes)


# A search of a known function on a box and a category


SPACE = MixedActions(BoxActions(0.0, 4.0), DiscreteActions([3.0, 5.0, 9.0]))
CENTER, HEIGHT = torch.tensor([3.2, 0.6, 1.7]), torch.tensor([1.0, 1.6, 1.3])
BEST = [0.6, 5.0]  # the action of the highest of the local optima


def utility(action):
    k = (action[:, 1:] == torch.tensor([3.0, 5.0, 9.0])).int().argmax(1)
    bump = HEIGHT[k] * torch.exp(-((action[:, 0] - CENTER[k]) ** 2) / 0.5)
    return (bump + 0.3 * torch.cos(4 * (action[:, 0] - CENTER[k]))).double()


def anywhere(action):
    return torch.ones(len(action)).bool()


def searched(*, permitted=anywhere, valid=anywhere):
    """Return what was found, and all that was asked, each with an error of .05."""
    asked, generator = [], torch.Generator().manual_seed(0)

    def evaluate(action):
        asked.append(action)
        error = torch.full((len(action),), 0.05).double()
        noise = torch.randn(len(action), generator=generator).double()
        share = valid(action).double()
        return Evaluations(action, utility(action) + error * noise, error, share)

    objective = Objective(
        actions=SPACE,
        permitted=permitted,
        evaluate=evaluate,
        num_evaluations=40,
        seed=0,
        min_probability_valid=0.5,
    )
    return GradientSearch().finalists(objective), torch.cat(asked)


def loss(action):
    return float(utility(torch.tensor([BEST]))[0] - utility(action).max())


def test_it_finds_the_highest_of_several_optima_that_can_be_measured():
    found, asked = searched()
    assert len(asked) == 40
    assert 1 <= len(found) <= 5
    assert SPACE.contains(found).all()
    assert loss(found) < 0.05
    # negative control: as many actions at random miss it more often
    at_random = [loss(SPACE.sample((5,), seed=s)) for s in range(2)]
    assert sum(at_random) > 8 * loss(found)
    # and where a measurement of the best is too improbable it is avoided
    assert (found[:, 1] == 5.0).any()
    found, _ = searched(valid=lambda action: 1 - 0.9 * (action[:, 1] == 5.0).float())
    assert (found[:, 1] != 5.0).all()


def test_nothing_that_is_not_permitted_is_asked_or_returned():
    permitted = lambda action: (action[:, 1] != 5.0) & (action[:, 0] < 1.5)  # noqa: E731
    found, asked = searched(permitted=permitted)
    assert permitted(torch.cat([found, asked])).all()
    grid = torch.cartesian_prod(torch.linspace(0, 1.499, 300), torch.tensor([3.0, 9.0]))
    assert float(utility(grid).max() - utility(found).max()) < 0.05
    with pytest.raises(ValueError, match="expected a constraint that permits a part"):
        searched(permitted=lambda action: ~anywhere(action))

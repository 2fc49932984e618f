"""A search of a known function on a box and a category."""

import pytest
import torch

from sbi_active import BoxActions, DiscreteActions, MixedActions
from sbi_active.design import GradientSearch
from sbi_active.design.search import Evaluations, Objective

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

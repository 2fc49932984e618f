import pytest
import torch

from sbi_active.design import GradientSearch
from tests.design.known import BEST, SPACE, Counted, objective, utility


def loss(action):
    return float(utility(torch.tensor([BEST]))[0] - utility(action).max())


def test_it_finds_the_highest_of_several_optima_that_can_be_measured():
    evaluate = Counted()
    found = GradientSearch().finalists(objective(evaluate))
    assert sum(map(len, evaluate.asked)) == 40
    assert 1 <= len(found) <= 5
    assert SPACE.contains(found).all()
    assert loss(found) < 0.05
    # negative control: as many actions at random miss it more often
    at_random = [loss(SPACE.sample((5,), seed=s)) for s in range(2)]
    assert sum(at_random) > 8 * loss(found)
    # and where a measurement of the best is too improbable it is avoided
    evaluate = Counted(valid=lambda action: 1 - 0.9 * (action[:, 1] == 5.0).float())
    assert (found[:, 1] == 5.0).any()
    found = GradientSearch().finalists(objective(evaluate, least=0.5))
    assert (found[:, 1] != 5.0).all()


def test_nothing_that_is_not_permitted_is_asked_or_returned():
    evaluate = Counted()
    permitted = lambda action: (action[:, 1] != 5.0) & (action[:, 0] < 1.5)  # noqa: E731
    found = GradientSearch().finalists(objective(evaluate, permitted=permitted))
    assert permitted(torch.cat([found, *evaluate.asked])).all()
    grid = torch.cartesian_prod(torch.linspace(0, 1.499, 300), torch.tensor([3.0, 9.0]))
    assert float(utility(grid).max() - utility(found).max()) < 0.05
    with pytest.raises(ValueError, match="expected a constraint that permits a part"):
        GradientSearch().finalists(
            objective(evaluate, permitted=lambda a: torch.zeros(len(a)).bool())
        )

import pytest
import torch

from sbi_active import BoxActions, DiscreteActions
from sbi_active.actions import ActionSpace
from sbi_active.search import ExhaustiveSearch, GradientSearch
from sbi_active.search.cube import Coordinates
from sbi_active.search.gradient import ascend
from tests.search.known import BEST, SPACE, Counted, objective, utility


def loss(action):
    return float(utility(torch.tensor([BEST]))[0] - utility(action).max())


def test_it_finds_the_highest_of_several_optima():
    losses = []
    for seed in range(4):
        evaluate = Counted()
        found = GradientSearch().finalists(objective(evaluate, seed=seed))
        assert sum(map(len, evaluate.asked)) == 40
        assert 1 <= len(found) <= 5
        assert SPACE.contains(found).all()
        losses.append(loss(found))
    assert max(losses) < 0.05
    # negative control: as many actions at random miss it more often
    at_random = [loss(SPACE.sample((5,), seed=s)) for s in range(4)]
    assert sum(at_random) > 4 * sum(losses)


def test_actions_of_a_round_are_apart():
    evaluate = Counted()
    GradientSearch(num_rounds=2).finalists(objective(evaluate))
    coordinates = Coordinates(SPACE)
    for action in evaluate.asked[1:]:
        point = coordinates.points(action)
        same = point[:, None, 1] == point[None, :, 1]
        apart = (point[:, None, 0] - point[None, :, 0]).abs()
        apart[~same | torch.eye(len(point)).bool()] = 1.0
        assert float(apart.min()) >= 0.02 - 1e-6


def test_starts_repel_each_other_where_the_score_is_flat():
    start = torch.tensor([[0.5], [0.52], [0.54]]).double()

    def run(repulsion):
        end = ascend(
            lambda z: 0.0 * z[:, 0],
            start,
            num_continuous=1,
            permitted=lambda z: torch.ones(len(z)).bool(),
            repulsion=repulsion,
        )
        return float(end.max() - end.min())

    assert run(1.0) > 3 * float(start.max() - start.min())
    assert run(0.0) == pytest.approx(0.04)


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


def test_a_measurement_that_is_too_improbable_is_avoided():
    evaluate = Counted(valid=lambda action: 1 - 0.9 * (action[:, 1] == 5.0).float())
    found = GradientSearch().finalists(objective(evaluate, least=0.5))
    assert (found[:, 1] != 5.0).all()
    free = GradientSearch().finalists(objective(evaluate))
    assert (free[:, 1] == 5.0).any()  # negative control


def test_given_evaluations_are_enough():
    action = SPACE.sample((120,), seed=0)
    found = GradientSearch().finalists(
        objective(None, num=0, known=Counted(0.05)(action))
    )
    assert loss(found) < 0.05


def test_coordinates_go_there_and_back():
    coordinates = Coordinates(SPACE)
    action = SPACE.sample((50,), seed=0)
    assert torch.allclose(coordinates.actions(coordinates.points(action)), action)
    point = coordinates.spread(30, 0)
    assert torch.bincount(point[:, 1].long()).tolist() == [10, 10, 10]
    assert (point[:, 0].sort().values.diff() < 0.1).all()


def test_errors():
    with pytest.raises(TypeError, match="expected DiscreteActions; got BoxActions"):
        ExhaustiveSearch().size(BoxActions(0.0, 1.0))
    with pytest.raises(TypeError, match="expected BoxActions or MixedActions"):
        GradientSearch().size(DiscreteActions([0.0, 1.0]))
    with pytest.raises(ValueError, match="expected num_rounds and num_finalists >= 1"):
        GradientSearch(num_finalists=0)
    with pytest.raises(ValueError, match="expected num_starts >= 1"):
        GradientSearch(num_starts=0)
    with pytest.raises(ValueError, match="expected a budget >= 1600"):
        GradientSearch().num_evaluations(1_000, 100)

    class Ball(ActionSpace):
        action_dim = 1

        def sample(self, sample_shape, *, seed=None):
            return torch.zeros(*sample_shape, 1)

        def contains(self, action):
            return torch.ones(action.shape[:-1]).bool()

    with pytest.raises(TypeError, match="expected boxes and lists of actions; got Bal"):
        Coordinates(Ball())

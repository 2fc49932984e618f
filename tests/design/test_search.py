import pytest
import torch

from sbi_active import BoxActions, DiscreteActions, MixedActions
from sbi_active.design import GradientSearch
from sbi_active.design.coordinates import Coordinates
from sbi_active.design.search import ascend
from tests.design.known import BEST, SPACE, Counted, objective, utility

PLANE = Coordinates(
    MixedActions(BoxActions([0.0, 0.0], [1.0, 1.0]), DiscreteActions([0.0, 1.0]))
)


def loss(action):
    return float(utility(torch.tensor([BEST]))[0] - utility(action).max())


def test_it_finds_the_highest_of_several_optima():
    losses = []
    for seed in range(2):
        evaluate = Counted()
        found = GradientSearch().finalists(objective(evaluate, seed=seed))
        assert sum(map(len, evaluate.asked)) == 40
        assert 1 <= len(found) <= 5
        assert SPACE.contains(found).all()
        losses.append(loss(found))
    assert max(losses) < 0.05
    # negative control: as many actions at random miss it more often
    at_random = [loss(SPACE.sample((5,), seed=s)) for s in range(2)]
    assert sum(at_random) > 4 * sum(losses)


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


def test_each_is_the_best_of_those_that_are_far_from_better_ones():
    generator = torch.Generator().manual_seed(0)
    category = torch.randint(2, (60, 1), generator=generator).double()
    point = torch.cat([torch.rand(60, 2, generator=generator).double(), category], 1)
    score = torch.rand(60, generator=generator)
    chosen = PLANE.spaced(point, score, 8, 0.3)
    assert len(chosen) == 8
    free = torch.ones(60, dtype=torch.bool)
    for i in chosen:
        assert i == torch.where(free, score, -1.0).argmax()
        near = (point[:, :2] - point[i, :2]).norm(dim=1) < 0.3
        free &= ~(near & (point[:, 2] == point[i, 2]))
    assert len(PLANE.spaced(point, score, 60, 0.9)) < 10  # no room for more


def test_influence_is_the_error_of_the_mean():
    """Over many data sets the mean varies as one data set says it does."""
    means, said = [], []
    z = torch.tensor([[0.4, 0.5, 1.0]], dtype=torch.float64)
    for seed in range(30):
        generator = torch.Generator().manual_seed(seed)
        point = torch.rand(60, 3, generator=generator, dtype=torch.float64)
        point[:, 2] = 1.0
        noise = 0.3 * torch.randn(60, generator=generator, dtype=torch.float64)
        value = torch.sin(5 * point[:, 0]) + 0.5 * point[:, 1] + 1.0 + noise
        surrogate = PLANE.regression(point, value, torch.full((60,), 0.3))
        with torch.no_grad():
            means.append(float(surrogate(z)[0]))
            influence = surrogate.influence(z)
        said.append(float(influence.square().sum()) ** 0.5)
    spread = torch.tensor(means).std()
    ratio = float(torch.tensor(said).mean() / spread)
    assert 0.5 < ratio < 1.5  # 4 standard errors of a standard deviation of 30, .5

import pytest
import torch

from sbi_active import BoxActions, DiscreteActions, MixedActions

BOX = BoxActions([0.0, -1.0], [2.0, 1.0], names=["speed", "angle"], units=["m/s", ""])
TOOLS = DiscreteActions([0.0, 1.0, 2.0], names=["tool"])
MIXED = MixedActions(BOX, TOOLS)


def test_box_samples_are_uniform_and_seeded():
    draws = BOX.sample((20_000,), seed=0)
    assert draws.shape == (20_000, 2)
    assert torch.equal(draws, BOX.sample((20_000,), seed=0))
    share = (draws - BOX.low) / (BOX.high - BOX.low)
    assert ((share >= 0) & (share <= 1)).all()
    for moment in (1, 2, 3):
        error = (1 / (2 * moment + 1) - 1 / (moment + 1) ** 2) ** 0.5 / 20_000**0.5
        distance = (share**moment).mean(0) - 1 / (moment + 1)
        assert (distance.abs() < 4 * error).all()
    assert BOX.sample((2, 3)).shape == (2, 3, 2)


def test_mixed_samples_are_those_of_independent_parts():
    draws = MIXED.sample((30_000,), seed=1)
    assert torch.equal(draws, MIXED.sample((30_000,), seed=1))
    assert MIXED.contains(draws).all()
    share = torch.bincount(draws[:, 2].long()) / 30_000
    assert ((share - 1 / 3).abs() < 4 * (2 / 9 / 30_000) ** 0.5).all()
    correlation = torch.corrcoef(draws.T)[~torch.eye(3).bool()]
    assert (correlation.abs() < 4 / 30_000**0.5).all()
    two = MixedActions(BoxActions(0.0, 1.0), BoxActions(0.0, 1.0)).sample((9,), seed=0)
    assert not torch.equal(two[:, 0], two[:, 1])  # a seed of its own each


def test_mixed_contains_and_lists():
    some = torch.tensor([[1.0, 0.0, 2.0], [1.0, 0.0, 0.5], [3.0, 0.0, 2.0]])
    assert MIXED.contains(some).tolist() == [True, False, False]
    assert MIXED.listed() is None
    lists = MixedActions(TOOLS, DiscreteActions([[1.0, 2.0], [3.0, 4.0]]))
    assert lists.listed().shape == (6, 3)
    assert lists.listed()[:3].tolist() == [[0, 1, 2], [0, 3, 4], [1, 1, 2]]
    assert lists.contains(lists.listed()).all()


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: DiscreteActions([]), "expected actions of shape"),
        (lambda: BoxActions(1.0, 1.0), "expected finite low < high"),
    ],
)
def test_bad_spaces(make, text):
    with pytest.raises(ValueError, match=text):
        make()
    with pytest.raises(TypeError, match="expected action spaces; got list"):
        MixedActions([0.0, 1.0])

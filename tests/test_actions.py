import pytest
import torch

from sbi_active import DiscreteActions


def test_scalar_values_become_rows():
    actions = DiscreteActions([1.0, 2.0, 3.0])
    assert actions.values.shape == (3, 1)
    assert actions.names == ["action"]


def test_vector_actions_keep_names_and_units():
    actions = DiscreteActions(
        [[0.0, 1.0], [2.0, 3.0]], names=["height", "speed"], units=["m", "m/s"]
    )
    assert actions.action_dim == 2
    assert actions.units == ["m", "m/s"]


def test_samples_are_uniform_and_seeded():
    actions = DiscreteActions(torch.arange(4.0))
    draws = actions.sample((40_000,), seed=0)
    assert draws.shape == (40_000, 1)
    assert torch.equal(draws, actions.sample((40_000,), seed=0))
    share = torch.bincount(draws[:, 0].long()) / 40_000
    assert ((share - 0.25).abs() < 4 * (0.25 * 0.75 / 40_000) ** 0.5).all()
    assert actions.sample((2, 3)).shape == (2, 3, 1)


def test_contains():
    actions = DiscreteActions(torch.arange(-5, 5.5, 0.5))
    inside = actions.contains(torch.tensor([[0.5], [0.25], [-5.0]]))
    assert inside.tolist() == [True, False, True]


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ([], "expected actions of shape"),
        (torch.zeros(2, 2, 2), "got \\(2, 2, 2\\)"),
        ([1.0, float("nan")], "expected finite actions"),
    ],
)
def test_bad_values(values, text):
    with pytest.raises(ValueError, match=text):
        DiscreteActions(values)


def test_wrong_number_of_names():
    with pytest.raises(ValueError, match="expected 1 names and units"):
        DiscreteActions([1.0], names=["a", "b"])

"""What a simulator may return, and what is refused."""

import numpy as np
import pytest
import torch
from sbi.utils import BoxUniform

from sbi_active import Campaign, DiscreteActions, SimulatorModel, simulate
from sbi_active.simulation import MissingRowsWarning, SimulationError

THETA = torch.arange(4.0)[:, None]


def x_of(function, **options):
    return simulate(lambda t, a, seeds: function(t), THETA, THETA, seed=0, **options).x


@pytest.mark.parametrize(
    "function",
    [
        lambda t: t.flip(0).numpy()[::-1],
        lambda t: t.tolist(),
        lambda t: t[:, 0],
        lambda t: np.broadcast_to(t.numpy(), t.shape),
    ],
)
def test_forms_of_x_that_are_taken(function, recwarn):
    assert torch.equal(x_of(function), THETA)
    assert not recwarn.list


def test_masked_numbers_were_not_measured():
    def function(theta):
        return np.ma.masked_greater(theta.repeat(1, 2).numpy() * [1, 0], 1.5)

    expected = torch.tensor([[0, 0], [1, 0], [torch.nan, 0], [torch.nan, 0]])
    assert torch.equal(x_of(function).nan_to_num(-1), expected.nan_to_num(-1))


def model_of(function):
    return SimulatorModel(lambda theta, action: function(theta))


BEYOND = [
    lambda t: t.double() + 1e39,
    lambda t: t.double().numpy() - 1e200,
    lambda t: [1e39] * len(t),
    lambda t: torch.where(t == 2, 1e39, t.double()),
]
COMPLEX = [
    lambda t: t + 1j,
    lambda t: t.numpy() + 1j,
    lambda t: [1j] * len(t),
    lambda t: np.fft.fft(t.numpy(), axis=0),
]
EMPTY = [
    lambda t: t[:, :0],
    lambda t: torch.zeros(len(t), 3, 0),
    lambda t: [[]] * len(t),
]


@pytest.mark.parametrize(
    ("functions", "text"),
    [
        (BEYOND, r"expected x within \+-3.4e38"),
        (COMPLEX, "expected x of real numbers; got .*complex"),
        (EMPTY, "expected at least one number a row of x"),
    ],
)
def test_numbers_that_would_be_lost_are_refused(functions, text):
    for function in functions:
        with pytest.raises(ValueError, match=text):
            x_of(function)
        with pytest.raises(ValueError, match=text):
            simulate(model_of(function), THETA, THETA, seed=0)


def test_a_row_without_an_outcome_is_missing():
    def row(theta, action, rng):
        return None if theta[0] == 2 else theta

    model = SimulatorModel(row, batched=False)
    with pytest.warns(MissingRowsWarning, match="expected an outcome .* got None"):
        rows = simulate(model, THETA, THETA, seed=0)
    assert rows.counts == {"ok": 3, "invalid": 0, "missing": 1}
    nothing = SimulatorModel(lambda theta, action, rng: None, batched=False)
    for simulator in (nothing, lambda theta, action: None):
        with pytest.raises(SimulationError, match="got None; return x"):
            simulate(simulator, THETA, THETA, seed=0)


def pairs(theta, action):
    """Return (n, n), where (n, 1) was meant: a number for each pair of rows."""
    return theta[:, 0] * action + torch.randn(len(theta), len(theta))


@pytest.mark.parametrize("wrap", [lambda fn: fn, SimulatorModel])
def test_a_number_for_each_pair_of_rows_is_refused_at_once(wrap):
    prior = BoxUniform(torch.zeros(2), torch.ones(2))
    with pytest.raises(ValueError, match="index both alike"):
        Campaign(wrap(pairs), prior, DiscreteActions([1.0, 2.0]))


def test_one_number_a_row_needs_no_axis():
    def flat(theta, action):
        return theta[:, 0] * action[:, 0]

    model = SimulatorModel(flat, noise=0.1)
    for num_rows in (1, 2, 300):
        ones = torch.ones(num_rows, 1)
        assert model.mean(ones, ones).shape == (num_rows, 1)
    assert Campaign(
        model, BoxUniform(torch.zeros(1), torch.ones(1)), DiscreteActions([1.0])
    ).x_shape == (1,)

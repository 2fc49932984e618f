"""What a simulator may return, and what is refused."""

import numpy as np
import pytest
import torch
from sbi.utils import BoxUniform

from sbi_active import (
    Campaign,
    DiscreteActions,
    SimulatorModel,
    simulate,
)
from sbi_active.campaign.trials import outcome_told
from sbi_active.inference.rounds.condition import outcome_rows
from sbi_active.seeding import row_normals
from sbi_active.simulation import MissingRowsWarning, SimulationError, check_simulator

THETA = torch.arange(4.0)[:, None]
ONE = torch.Size([1])


def x_of(function, **options):
    return simulate(lambda t, a, seeds: function(t), THETA, THETA, seed=0, **options).x


@pytest.mark.parametrize(
    "function",
    [
        lambda t: t.flip(0).numpy()[::-1],
        lambda t: t.numpy().astype(">f8"),
        lambda t: t.numpy().astype(np.uint32),
        lambda t: t.numpy().astype(object),
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


@pytest.mark.parametrize(
    ("x", "text"),
    [
        *((x, r"within \+-3.4e38") for x in (1e39, [1e39], np.float64(-1e39))),
        (torch.tensor([1e39], dtype=torch.float64), r"within \+-3.4e38"),
        *((x, "of real numbers") for x in (1j, [1j], np.array([1 + 0j]))),
        (torch.tensor([1j]), "of real numbers"),
    ],
)
def test_an_outcome_that_float32_cannot_hold_is_refused(x, text):
    for take in (outcome_rows, outcome_told):
        with pytest.raises(ValueError, match=f"expected x {text}"):
            take(x, ONE)


@pytest.mark.parametrize("name", ["theta", "action"])
def test_complex_parameters_and_actions_are_refused(name):
    rows = {"theta": THETA, "action": THETA}
    rows[name] = rows[name] + 1j
    with pytest.raises(ValueError, match=f"expected {name} of real numbers"):
        simulate(lambda t, a: t, **rows, seed=0)


@pytest.mark.parametrize("lost", [torch.nan, torch.inf])
@pytest.mark.parametrize("mixes", [False, True])
def test_the_check_of_rows_without_a_measurement(lost, mixes):
    def simulator(theta, action, seeds):
        x = theta + row_normals(seeds, 1).float()
        x = x + x[:1] if mixes else x  # the order of rows matters
        return torch.where(theta > 0.8, lost, x)

    prior = BoxUniform(torch.zeros(1), torch.ones(1))
    report = check_simulator(simulator, prior, DiscreteActions([1.0]), num_rows=64)
    assert report.counts["invalid"] > 0
    assert report.rows_are_independent is not mixes
    assert not report.is_deterministic


def pairs(theta, action):
    """Return (n, n), where (n, 1) was meant: a number for each pair of rows."""
    return theta[:, 0] * action + torch.randn(len(theta), len(theta))


@pytest.mark.parametrize("wrap", [lambda fn: fn, SimulatorModel])
def test_a_number_for_each_pair_of_rows_is_refused_at_once(wrap):
    prior = BoxUniform(torch.zeros(2), torch.ones(2))
    with pytest.raises(ValueError, match="index both alike"):
        Campaign(wrap(pairs), prior, DiscreteActions([1.0, 2.0]))


def test_x_may_be_as_wide_as_it_is_long():
    def wide(theta, action):
        return theta[:, :1] * action + torch.randn(len(theta), 16)

    model = SimulatorModel(wide)
    for num_rows in (16, 4, 16, 1, 300):
        assert model(torch.ones(num_rows, 1), torch.ones(num_rows, 1)).shape[1] == 16
    prior = BoxUniform(torch.zeros(1), torch.ones(1))
    assert Campaign(wide, prior, DiscreteActions([1.0, 2.0])).x_shape == (16,)


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

"""What users write as a simulator: taken where it is clear, refused where it is not."""

import numpy as np
import pytest
import torch
from sbi.utils import BoxUniform

from sbi_active import (
    Campaign,
    DiscreteActions,
    GaussianNoise,
    InformationGainDesigner,
    RandomDesigner,
    SimulatorModel,
    simulate,
)
from sbi_active.criticism import Criticism, Trials
from sbi_active.simulation import MissingRowsWarning, SimulationError, check_simulator
from sbi_active.simulation.simulator import require_noise

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


BEYOND = [lambda t: t.double().numpy() - 1e200, lambda t: [1e39] * len(t)]
COMPLEX = [lambda t: t + 1j, lambda t: t.numpy() + 1j, lambda t: [1j] * len(t)]
EMPTY = [lambda t: torch.zeros(len(t), 3, 0), lambda t: [[]] * len(t)]


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
    prior = BoxUniform(torch.zeros(1), torch.ones(1))
    assert Campaign(model, prior, DiscreteActions([1.0])).x_shape == (1,)


def test_counts_that_are_equal_by_chance_prove_no_missing_noise():
    counts = torch.tensor([[1.0], [0.0], *[[1.0]] * 14])
    require_noise(counts, counts)
    with pytest.raises(ValueError, match="expected a simulator with noise"):
        require_noise(torch.ones(16, 1), torch.ones(16, 1))
    with pytest.raises(ValueError, match="expected a simulator with noise"):
        require_noise(torch.arange(16.0)[:, None], torch.arange(16.0)[:, None])


PRIOR = BoxUniform(torch.zeros(1), torch.ones(1))
MODEL = SimulatorModel(lambda theta, action: theta * action, noise=0.02)
ROWS = torch.rand(4, 1), torch.rand(4, 1)
ACTIONS = [0.1, 1.0, 3.0]


def test_a_number_as_noise_is_a_gaussian_standard_deviation():
    assert isinstance(MODEL.noise, GaussianNoise)
    assert MODEL.noise.sd.item() == 0.02
    several = SimulatorModel(lambda theta, action: theta, noise=[0.1, 0.2])
    assert several.noise.sd.tolist() == [0.1, 0.2]
    with pytest.raises(ValueError, match="expected sd of real numbers"):
        SimulatorModel(lambda theta, action: theta, noise="small")


@pytest.mark.parametrize("make", [list, tuple, np.array, torch.tensor])
def test_a_list_of_actions_is_taken(make):
    actions = make(ACTIONS)
    campaign = Campaign(MODEL, PRIOR, actions)
    assert campaign.actions.values[:, 0].tolist() == pytest.approx(ACTIONS)
    assert InformationGainDesigner(actions).actions.action_dim == 1
    assert RandomDesigner(actions).select(seed=0).action.shape == (1,)
    assert check_simulator(MODEL, PRIOR, actions, num_rows=16).is_ready
    trials = Trials([1.0, 2.0, 3.0], [0.5, 1.0, 1.5])
    assert Criticism(MODEL, PRIOR, trials, actions=actions).actions.action_dim == 1


def test_a_function_of_one_row_says_so():
    def row(theta, action, rng):
        return theta * action + rng.normal()

    with pytest.raises(TypeError, match="'rng'"):
        SimulatorModel(row)(*ROWS)
    with pytest.raises(ValueError, match="batched=False"):
        simulate(lambda theta, action: theta[0] * action[0], *ROWS, seed=0)
    with pytest.raises(SimulationError, match="batched=False"):
        simulate(lambda theta, action: {}[float(theta[0, 0])], *ROWS, seed=0)

"""Arrays that a simulator or a caller changes after they were handed over."""

import sys
import warnings

import cloudpickle
import numpy as np
import pytest
import torch

from sbi_active import BoxActions, DiscreteActions, SimulatorModel, simulate
from sbi_active.inference.rounds.condition import action_rows, outcome_rows
from sbi_active.seeding import row_normals
from sbi_active.simulation import GaussianNoise, MissingRowsWarning

# A worker cannot import a test module.
cloudpickle.register_pickle_by_value(sys.modules[__name__])

THETA = torch.linspace(0, 0.2, 600)[:, None]
ACTION = torch.ones(600, 1)
ENGINE = [{}, {"batch_size": 7}]


class State:
    """What MuJoCo calls data: one set of arrays for all rows."""

    def __init__(self):
        self.qpos = np.zeros(2)


def one_row(theta, action, rng, *, context):
    context.qpos[:] = theta[0], -action[0]
    return context.qpos


@pytest.mark.parametrize("options", ENGINE)
@pytest.mark.parametrize("noise", [None, GaussianNoise(0.0)])
def test_rows_that_return_a_view_keep_their_own_x(options, noise):
    model = SimulatorModel(one_row, batched=False, setup=State, noise=noise)
    x = simulate(model, THETA, ACTION, seed=0, **options).x
    expected = torch.cat([THETA, -ACTION], 1)
    assert torch.equal(x, expected)
    if noise is not None:
        assert torch.equal(model.mean(THETA, ACTION).float(), expected)


class Buffer:
    """Returns a part of the one array that it works in, filled anew in each call."""

    def __init__(self, kind):
        self.kind = kind
        self.buffer = torch.zeros(1000, 3)

    def __call__(self, theta, action):
        part = self.buffer[: len(theta), 1:2]
        part.copy_(2 * theta)
        return part if self.kind == "torch" else part.numpy()


class SeededBuffer(Buffer):
    def __call__(self, theta, action, seeds):
        return super().__call__(theta, action)


@pytest.mark.parametrize("options", ENGINE)
@pytest.mark.parametrize("make", [Buffer, SeededBuffer])
@pytest.mark.parametrize("kind", ["torch", "numpy"])
def test_a_simulator_may_return_the_buffer_it_fills_again(kind, make, options):
    x = simulate(make(kind), THETA, ACTION, seed=0, **options).x
    assert torch.equal(x, 2 * THETA)


def test_a_mean_is_not_overwritten_by_the_next():
    model = SimulatorModel(Buffer("torch"), noise=1.0)
    mean = model.mean(THETA, ACTION)
    model.mean(5 * THETA, ACTION)
    assert torch.equal(mean, 2 * THETA)


def test_a_random_buffer_is_no_noise_free_output():
    buffer = torch.zeros(8, 1)

    def fn(theta, action):
        return buffer[: len(theta)].normal_()

    model = SimulatorModel(fn, noise=1.0)
    assert not model.is_deterministic(THETA, ACTION)


def change(theta, action, seeds):
    """Change all arguments in place, torch's and through NumPy."""
    theta.mul_(2)
    action.numpy()[:] += 1
    seeds.zero_()


def changing(theta, action, seeds):
    x = theta + action + row_normals(seeds, 1).float()
    change(theta, action, seeds)
    return x


def changing_blocks(theta, action):
    x = theta + action
    change(theta, action, torch.zeros(1))
    return x


KEPT = []


def keeping(theta, action, seeds):
    for old in KEPT:
        old.fill_(torch.nan)
    KEPT[:] = [*KEPT[-8:], theta, action]
    return theta + action + row_normals(seeds, 1).float()


SIMULATORS = [
    changing,
    keeping,
    changing_blocks,
    SimulatorModel(changing),
    SimulatorModel(changing, noise=1.0),
    SimulatorModel(changing_blocks, noise=1.0),
]


@pytest.mark.parametrize("options", ENGINE)
@pytest.mark.parametrize("simulator", SIMULATORS)
def test_a_simulator_may_change_its_arguments(simulator, options):
    theta, action = THETA.clone(), ACTION.clone()
    rows = simulate(simulator, theta, action, seed=3, **options)
    assert torch.equal(theta, THETA)
    assert torch.equal(action, ACTION)
    theta.zero_()
    action.zero_()
    assert torch.equal(rows.theta, THETA)  # as simulated
    assert torch.equal(rows.action, ACTION)
    assert torch.equal(rows.x, simulate(simulator, THETA, ACTION, seed=3).x)


def test_a_row_that_is_tried_again_gets_its_own_theta():
    theta, action = torch.arange(300.0)[:, None], torch.zeros(300, 1)

    def simulator(theta, action, seeds):
        rows = theta.clone()
        theta += 1000
        if bool(torch.isin(rows, torch.tensor([5.0, 70.0, 200.0])).any()):
            raise RuntimeError("no")
        return rows

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MissingRowsWarning)
        rows = simulate(simulator, theta, action, seed=0)
    assert rows.tracebacks.keys() == {5, 70, 200}
    assert torch.equal(rows.x[rows.valid], theta[rows.valid])


def test_a_model_called_directly_may_change_its_arguments():
    effect, seeds = torch.ones(600, 1), torch.arange(600)

    def fn(theta, action, seeds, gain=0.0):
        gain += 1
        return changing(theta, action, seeds) * gain

    theta, action = THETA.clone(), ACTION.clone()
    SimulatorModel(fn)(theta, action, seeds=seeds, gain=effect)
    assert torch.equal(theta, THETA)
    assert torch.equal(action, ACTION)
    assert torch.equal(effect, torch.ones(600, 1))
    assert torch.equal(seeds, torch.arange(600))


def test_effects_of_rows_may_be_changed():
    def fn(theta, action, rng, gain=None):
        gain += 1
        return theta + gain

    effect = torch.zeros(4, 1, dtype=torch.float64)
    model = SimulatorModel(fn, batched=False, noise=1.0)
    for _ in range(2):
        mean = model.mean(THETA[:4], ACTION[:4], gain=effect)
        assert torch.equal(mean - 1, THETA[:4])


def test_noise_keeps_the_values_that_were_declared():
    sd, times = torch.ones(2, dtype=torch.float64), np.arange(3.0)
    noise = GaussianNoise(sd).at(times)
    model = SimulatorModel(changing, noise=1.0, sample_times=times)
    sd.fill_(9.0)
    times += 7
    assert noise.sd.tolist() == [1.0, 1.0]
    for kept in (noise.times, model.sample_times, model.noise.times):
        assert kept.tolist() == [0.0, 1.0, 2.0]


def test_actions_keep_the_values_that_were_given():
    values, low, high = np.arange(3, dtype=np.float32), torch.zeros(1), torch.ones(1)
    listed, box = DiscreteActions(values), BoxActions(low, high)
    for given in (values, low, high):
        given += 5
    assert listed.values.flatten().tolist() == [0.0, 1.0, 2.0]
    assert (box.low.item(), box.high.item()) == (0.0, 1.0)


def test_conditions_are_rows_of_their_own():
    x, action = torch.ones(3, 2), torch.ones(3, 1)
    rows = outcome_rows(x, (2,)), action_rows(action, 1)
    x.zero_()
    action.zero_()
    assert all(r.unique().tolist() == [1.0] for r in rows)

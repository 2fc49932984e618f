import os
import pickle

import numpy as np
import pytest
import torch

from sbi_active import GaussianNoise, SimulatorModel
from sbi_active.seeding import row_normals, row_seeds
from sbi_active.simulation.model import takes_seeds

THETA = torch.tensor([[1.0, 2.0], [3.0, -1.0], [0.5, 0.0]])
ACTION = torch.tensor([[2.0], [1.0], [-1.0]])
SEEDS = row_seeds(0, 3)


def line(theta, action, *, drag=0.0, tilt=0.0):
    drag, tilt = (torch.as_tensor(e).reshape(-1, 1) for e in (drag, tilt))
    return theta[:, :1] + theta[:, 1:] * action - drag * action**2 + tilt


def line_row(theta, action, rng, *, drag=0.0, tilt=0.0):
    assert isinstance(theta, np.ndarray)
    assert theta.dtype == action.dtype == np.float64
    assert isinstance(rng, np.random.Generator)
    return theta[0] + theta[1] * action - drag * action**2 + tilt


def noisy_row(theta, action, rng):
    return theta + action + rng.normal(size=2)


def noisy(theta, action, seeds):
    return theta + action + row_normals(seeds, 2)


@pytest.fixture(params=["batched", "rows"])
def model(request):
    batched = request.param == "batched"
    fn = line if batched else line_row
    return SimulatorModel(fn, noise=GaussianNoise(0.1), batched=batched)


def test_effects_are_numbers_or_one_a_row(model):
    assert model.effect_names == ("drag", "tilt")
    mean = model.mean(THETA, ACTION)
    dragged = model.mean(THETA, ACTION, drag=2.0)
    assert torch.allclose(dragged, mean - 2.0 * ACTION**2)
    own = torch.tensor([0.0, 1.0, 3.0])
    both = model.mean(THETA, ACTION, drag=own, tilt=1.0)
    assert torch.allclose(both, mean - own[:, None] * ACTION**2 + 1)
    x = model(THETA, ACTION, SEEDS, drag=2.0)
    assert torch.allclose(x - dragged, model(THETA, ACTION, SEEDS) - mean, atol=1e-6)
    with pytest.raises(TypeError, match="unexpected keyword argument 'friction'"):
        model(THETA, ACTION, SEEDS, friction=1.0)


@pytest.mark.parametrize(
    "model",
    [
        SimulatorModel(noisy),
        SimulatorModel(noisy_row, batched=False),
        SimulatorModel(noisy, noise=GaussianNoise(1.0)),
        SimulatorModel(line_row, batched=False, noise=GaussianNoise(1.0)),
    ],
)
def test_rows_depend_on_their_seeds_alone(model):
    assert takes_seeds(model)
    x = model(THETA, ACTION, SEEDS)
    order = torch.tensor([2, 0])
    assert torch.equal(model(THETA[order], ACTION[order], SEEDS[order]), x[order])
    assert not torch.equal(model(THETA, ACTION, SEEDS + 1), x)
    torch.manual_seed(4)
    first = model(THETA, ACTION)
    torch.manual_seed(4)
    assert torch.equal(model(THETA, ACTION), first)
    assert not torch.equal(model(THETA, ACTION), first)


def test_a_random_function_has_no_mean():
    with pytest.raises(ValueError, match="expected a simulator with a noise model"):
        SimulatorModel(noisy).mean(THETA, ACTION)
    for model in (
        SimulatorModel(noisy, noise=GaussianNoise(1.0)),
        SimulatorModel(noisy_row, batched=False, noise=GaussianNoise(1.0)),
        SimulatorModel(lambda t, a: torch.randn_like(t), noise=GaussianNoise(1.0)),
    ):
        assert not model.is_deterministic(THETA, ACTION)
        with pytest.raises(ValueError, match="got different outputs from two seeds"):
            model.mean(THETA, ACTION)


def setup():
    return {"pid": os.getpid(), "mark": np.random.default_rng().random()}


def with_context(theta, action, rng, context):
    return np.array([context["pid"], context["mark"]])


def test_setup_runs_once_a_process():
    model = SimulatorModel(with_context, batched=False, setup=setup)
    assert model.effect_names == ()
    here = model(THETA, ACTION)
    assert here[:, 0].tolist() == 3 * [os.getpid()]
    assert here.unique(dim=0).shape[0] == 1
    assert torch.equal(model(THETA, ACTION), here)
    again = pickle.loads(pickle.dumps(model))
    assert torch.equal(again(THETA, ACTION), here)
    other = SimulatorModel(with_context, batched=False, setup=setup)
    assert other(THETA, ACTION)[0, 1] != here[0, 1]


@pytest.mark.parametrize("sd", [0.0, 1.0])
def test_rows_that_raise_do_not_hide_whether_the_others_are_random(sd):
    def unstable(theta, action, rng):
        if theta[0] > 2:
            raise FloatingPointError("unstable")
        return theta + sd * rng.normal(size=2)

    model = SimulatorModel(unstable, batched=False, noise=GaussianNoise(1.0))
    assert model.is_deterministic(THETA, ACTION) == (sd == 0)
    with pytest.raises(FloatingPointError, match="unstable"):
        SimulatorModel(unstable, batched=False).is_deterministic(THETA[1:2], ACTION[:1])


NAN = torch.tensor([[1.0, torch.nan], [0, 0], [0, 0]])


@pytest.mark.parametrize(
    ("run", "text"),
    [
        (lambda m: m(THETA[:2], ACTION), r"as many rows; got \(2, 2\) and \(3, 1\)"),
        (lambda m: m(THETA[0], ACTION), "expected theta"),
        (lambda m: m(NAN, ACTION), r"finite theta; got \[1.0, nan\] in row 0"),
        (lambda m: m(THETA, ACTION / 0), "expected finite action; got"),
        (lambda m: m(THETA[:, :1], ACTION), "expected 2 parameters, a, b; got theta"),
    ],
)
def test_bad_input(run, text):
    for batched, fn in ((True, line), (False, line_row)):
        model = SimulatorModel(fn, batched=batched, parameter_names=["a", "b"])
        with pytest.raises(ValueError, match=text):
            run(model)


def ragged(theta, action, rng):
    return np.zeros(1 + int(theta[0]))


@pytest.mark.parametrize(
    ("fn", "options", "text"),
    [
        (lambda t, a: 3.0, {}, r"expected x with one row a parameter set"),
        (line, {"channel_names": ["x", "y"]}, "expected 2 channels, x, y; got x of"),
        (ragged, {"batched": False}, r"of one shape, \(2,\); got \(4,\) in row 1"),
    ],
)
def test_bad_output(fn, options, text):
    with pytest.raises(ValueError, match=text):
        SimulatorModel(fn, **options)(THETA, ACTION)

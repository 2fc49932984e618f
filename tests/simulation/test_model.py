"""Models of simulators, and what users write as one."""

import os
import pickle

import numpy as np
import pytest
import torch
from sbi.utils import BoxUniform

from sbi_active import Campaign, GaussianNoise, SimulatorModel, simulate
from sbi_active.criticism import Criticism, Trials
from sbi_active.design import InformationGainDesigner, RandomDesigner
from sbi_active.seeding import row_normals, row_seeds
from sbi_active.simulation import MissingRowsWarning, SimulationError, check_simulator
from sbi_active.simulation.model import takes_seeds
from sbi_active.simulation.simulator import require_noise

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
    return SimulatorModel(fn, noise=0.1, batched=batched)


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


#: Models that take seeds.
SEEDED = [
    SimulatorModel(noisy),
    SimulatorModel(noisy_row, batched=False),
    SimulatorModel(noisy, noise=1.0),
    SimulatorModel(line_row, batched=False, noise=1.0),
]


@pytest.mark.parametrize("model", SEEDED)
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
        SimulatorModel(noisy, noise=1.0),
        SimulatorModel(noisy_row, batched=False, noise=1.0),
        SimulatorModel(lambda t, a: torch.randn_like(t), noise=1.0),
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

    model = SimulatorModel(unstable, batched=False, noise=1.0)
    assert model.is_deterministic(THETA, ACTION) == (sd == 0)
    with pytest.raises(FloatingPointError, match="unstable"):
        SimulatorModel(unstable, batched=False).is_deterministic(THETA[1:2], ACTION[:1])


NAN = torch.tensor([[1.0, torch.nan], [0, 0], [0, 0]])


#: Calls of a model, and what is said of them.
BAD_INPUT = [
    (lambda m: m(THETA[:2], ACTION), r"as many rows; got \(2, 2\) and \(3, 1\)"),
    (lambda m: m(THETA[0], ACTION), "expected theta"),
    (lambda m: m(NAN, ACTION), r"finite theta; got \[1.0, nan\] in row 0"),
    (lambda m: m(THETA, ACTION / 0), "expected finite action; got"),
    (lambda m: m(THETA[:, :1], ACTION), "expected 2 parameters, a, b; got theta"),
]


@pytest.mark.parametrize(("run", "text"), BAD_INPUT)
def test_bad_input(run, text):
    for batched, fn in ((True, line), (False, line_row)):
        model = SimulatorModel(fn, batched=batched, parameter_names=["a", "b"])
        with pytest.raises(ValueError, match=text):
            run(model)


def ragged(theta, action, rng):
    return np.zeros(1 + int(theta[0]))


#: Functions, options, and what is said of their output.
BAD_OUTPUT = [
    (lambda t, a: 3.0, {}, r"expected x with one row a parameter set"),
    (line, {"channel_names": ["x", "y"]}, "expected 2 channels, x, y; got x of"),
    (ragged, {"batched": False}, r"of one shape, \(2,\); got \(4,\) in row 1"),
]


@pytest.mark.parametrize(("fn", "options", "text"), BAD_OUTPUT)
def test_bad_output(fn, options, text):
    with pytest.raises(ValueError, match=text):
        SimulatorModel(fn, **options)(THETA, ACTION)


# What users write as a simulator: taken where it is clear, refused where it is not


FOUR = torch.arange(4.0)[:, None]


def x_of(function, **options):
    return simulate(lambda t, a, seeds: function(t), FOUR, FOUR, seed=0, **options).x


#: Forms of x.
FORMS = [
    lambda t: t.flip(0).numpy()[::-1],
    lambda t: t.tolist(),
    lambda t: t[:, 0],
    lambda t: np.broadcast_to(t.numpy(), t.shape),
]


@pytest.mark.parametrize("function", FORMS)
def test_forms_of_x_that_are_taken(function, recwarn):
    assert torch.equal(x_of(function), FOUR)
    assert not recwarn.list


def test_masked_numbers_were_not_measured():
    def function(theta):
        return np.ma.masked_greater(theta.repeat(1, 2).numpy() * [1, 0], 1.5)

    expected = torch.tensor([[0, 0], [1, 0], [torch.nan, 0], [torch.nan, 0]])
    assert torch.equal(x_of(function).nan_to_num(-1), expected.nan_to_num(-1))


def model_from(function):
    return SimulatorModel(lambda theta, action: function(theta))


BEYOND = [lambda t: t.double().numpy() - 1e200, lambda t: [1e39] * len(t)]
COMPLEX = [lambda t: t + 1j, lambda t: t.numpy() + 1j, lambda t: [1j] * len(t)]
EMPTY = [lambda t: torch.zeros(len(t), 3, 0), lambda t: [[]] * len(t)]


#: Functions, and what is said of them.
LOST = [
    (BEYOND, r"expected x within \+-3.4e38"),
    (COMPLEX, "expected x of real numbers; got .*complex"),
    (EMPTY, "expected at least one number a row of x"),
]


@pytest.mark.parametrize(("functions", "text"), LOST)
def test_numbers_that_would_be_lost_are_refused(functions, text):
    for function in functions:
        with pytest.raises(ValueError, match=text):
            x_of(function)
        with pytest.raises(ValueError, match=text):
            simulate(model_from(function), FOUR, FOUR, seed=0)


def test_a_row_without_an_outcome_is_missing():
    def row(theta, action, rng):
        return None if theta[0] == 2 else theta

    model = SimulatorModel(row, batched=False)
    with pytest.warns(MissingRowsWarning, match="expected an outcome .* got None"):
        rows = simulate(model, FOUR, FOUR, seed=0)
    assert rows.counts == {"ok": 3, "invalid": 0, "missing": 1}
    nothing = SimulatorModel(lambda theta, action, rng: None, batched=False)
    for simulator in (nothing, lambda theta, action: None):
        with pytest.raises(SimulationError, match="got None; return x"):
            simulate(simulator, FOUR, FOUR, seed=0)


def pairs(theta, action):
    """Return (n, n), where (n, 1) was meant: a number for each pair of rows."""
    return theta[:, 0] * action + torch.randn(len(theta), len(theta))


@pytest.mark.parametrize("wrap", [lambda fn: fn, SimulatorModel])
def test_a_number_for_each_pair_of_rows_is_refused_at_once(wrap):
    prior = BoxUniform(torch.zeros(2), torch.ones(2))
    with pytest.raises(ValueError, match="index both alike"):
        Campaign(wrap(pairs), prior, [1.0, 2.0])


def test_one_number_a_row_needs_no_axis():
    def flat(theta, action):
        return theta[:, 0] * action[:, 0]

    model = SimulatorModel(flat, noise=0.1)
    for num_rows in (1, 2, 300):
        ones = torch.ones(num_rows, 1)
        assert model.mean(ones, ones).shape == (num_rows, 1)
    prior = BoxUniform(torch.zeros(1), torch.ones(1))
    assert Campaign(model, prior, [1.0]).x_shape == (1,)


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
SOME = [0.1, 1.0, 3.0]


def test_a_number_as_noise_is_a_gaussian_standard_deviation():
    assert isinstance(MODEL.noise, GaussianNoise)
    assert MODEL.noise.sd.item() == 0.02
    several = SimulatorModel(lambda theta, action: theta, noise=[0.1, 0.2])
    assert several.noise.sd.tolist() == [0.1, 0.2]
    with pytest.raises(ValueError, match="expected sd of real numbers"):
        SimulatorModel(lambda theta, action: theta, noise="small")


@pytest.mark.parametrize("make", [list, tuple, np.array, torch.tensor])
def test_a_list_of_actions_is_taken(make):
    actions = make(SOME)
    campaign = Campaign(MODEL, PRIOR, actions)
    assert campaign.actions.values[:, 0].tolist() == pytest.approx(SOME)
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

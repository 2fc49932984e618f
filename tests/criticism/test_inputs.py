"""The loop on recordings with inputs over time, measured starts and dense samples."""

import numpy as np
import pytest
import torch
from sbi.utils import BoxUniform

from sbi_active.actions import DiscreteActions
from sbi_active.criticism import (
    AugmentedSimulator,
    Criticism,
    Trials,
    close_loop,
    generic_effects,
)
from sbi_active.criticism.data.measurements import Measurements
from sbi_active.criticism.linear.screening import Sampling, suggested_sampling, thinned
from sbi_active.criticism.report.page import figures
from sbi_active.criticism.rivals.trial_simulator import TrialSimulator
from sbi_active.simulation import AutocorrelatedNoise, GaussianNoise, SimulatorModel
from tests.criticism.motor_world import LIBRARY, MODEL, PRIOR, measured
from tests.effects import autocorrelated, effect, normal, with_error


def test_what_a_motor_lacks_is_found_proposed_and_simulated_on():
    trials = measured(0, {"dead zone": 0.25})
    loop = Criticism(MODEL, PRIOR, trials, effects=LIBRARY, actions=trials.action)
    report = loop.report()
    assert report.verdict == "dead zone"
    rmse = report.before_after.set_index("metric").loc["rmse"]
    assert rmse["after"] < 0.06 < rmse["before"]
    panels = [ax.get_xlabel() for ax in figures(report)["residuals"].axes]
    assert panels == ["trial", "time [s]"] * 2  # the label has none of its own
    # Recorded inputs alone can be played again.
    assert report.next_action.candidates[:, 0].tolist() == [*range(8)]
    assert all(test.is_permitted for test in report.severe_tests)
    model, prior = loop.add()
    assert prior.event_shape == (3,)
    run = {"inputs": trials.inputs, "input_times": trials.input_times}
    run |= {"times": trials.sample_times.expand(len(trials), -1), "start": trials.start}
    for dead_zone, largest in ((0.25, 0.06), (0.0, 1.0)):
        z = torch.tensor([[3.0, 0.3, dead_zone]]).double().expand(len(trials), -1)
        error = model.mean(z, trials.action, **run) - trials.x
        assert float(error.square().mean().sqrt()) < largest
    assert float(error.square().mean().sqrt()) > 0.1


def test_equal_actions_with_other_inputs_are_simulated_apart():
    def summed(theta, action, *, inputs):
        return theta * inputs["u"].sum(1, keepdim=True) + action

    model = SimulatorModel(summed, noise=0.1)
    inputs = {"u": torch.tensor([[1.0, 2.0], [3.0, 4.0], [1.0, 2.0]])}
    given = {"inputs": inputs, "input_times": [0.0, 1.0]}
    trials = Trials(torch.zeros(3), torch.zeros(3), **given)
    simulator = TrialSimulator(AugmentedSimulator(model, []), trials)
    assert simulator.predict(torch.ones(1, 1), {})[0].tolist() == [[3.0, 7.0, 3.0]]


def test_a_function_of_one_row_gets_its_own_inputs():
    shapes = []

    def one(theta, action, rng, *, inputs, times, input_times, start):
        each = inputs["u"], times, input_times, start["q"]
        shapes.append(tuple(part.shape for part in each))
        return theta * inputs["u"].sum() + start["q"]

    model = SimulatorModel(one, noise=0.1, batched=False)
    trials = Trials(
        None,
        torch.zeros(2, 1),
        sample_times=[0.5],
        inputs={"u": torch.tensor([[1.0, 2.0, 0.0], [3.0, 4.0, 0.0]])},
        input_times=[0.0, 0.5, 1.0],
        start={"q": [1.0, 2.0]},
    )
    simulator = TrialSimulator(AugmentedSimulator(model, []), trials)
    mean, _, _ = simulator.predict(torch.ones(1, 1), {})
    assert mean.tolist() == [[4.0, 9.0]]
    assert {*shapes} == {((3,), (1,), (3,), ())}


def falling(theta, action, *, times):  # which cannot do without them
    return action - 0.5 * theta * times**2


@pytest.mark.parametrize("by_model", [True, False])
def test_a_simulator_may_require_times(by_model):
    times = torch.linspace(0.1, 1.0, 8)
    noise = GaussianNoise(0.02)
    own = times if by_model else None
    model = SimulatorModel(falling, noise=noise, sample_times=own)
    prior = BoxUniform(torch.tensor([5.0]), torch.tensor([15.0]))
    action = torch.linspace(1, 3, 6)[:, None]
    x = with_error(falling(torch.tensor([[9.81]]), action, times=times) + 0.3, 0.02)
    trials = Trials(action, x, sample_times=times)
    effects = [effect(prior=normal(0.5))]
    if by_model:
        generic = generic_effects(model, DiscreteActions(action), prior=prior)
        effects += [e for e in generic if e.name not in ("bias", "action offset")]
    given = {"effects": effects, "evaluate": False, "plan": False}
    report = close_loop(model, prior, trials, **given)
    assert report.verdict == "bias"


def test_inputs_have_to_cover_the_times_of_a_model():
    def follow(theta, action, *, inputs):
        return theta * inputs["u"][:, :5]

    model = SimulatorModel(follow, noise=0.1, sample_times=torch.linspace(0, 1, 5))
    prior = BoxUniform(torch.zeros(1), torch.ones(1))
    inputs, grid = {"u": torch.ones(3, 11)}, torch.linspace(0, 2, 11)
    given = {"action": None, "x": torch.zeros(3, 5), "inputs": inputs}
    Criticism(model, prior, Trials(**given, input_times=grid))
    with pytest.raises(ValueError, match="x of trial 0 measured within .* 50 to"):
        Criticism(model, prior, Trials(**given, input_times=50 + grid))


# Generic effects of recordings: which there are, and that a loop finds them


@pytest.mark.parametrize(("name", "size"), [("input delay", 0.07), ("backlash", 0.5)])
def test_what_an_actuator_does_is_found(name, size):
    given = {"num": 5, "held_out": 0}
    rivals = {"input gain", "input lag", "input delay", "backlash"}
    effects = generic_effects(MODEL, measured(0, {}, **given), prior=PRIOR)
    effects = [own for own in effects if own.name in rivals]
    trials = measured(0, {name: size}, **given, library=effects)
    tracing = Criticism(MODEL, PRIOR, trials, effects=effects).trace()
    named = {part for g in tracing.equivalent if name in g for part in g}
    assert tracing.verdict in {name} | named
    for other in ("input lag", name):
        assert not any({"none", other} <= group for group in tracing.equivalent)


def two_sensors(theta, action, *, inputs, times):
    """An angle and its rate, which follow the input at once."""
    u = inputs["u"]
    x = torch.stack([theta * u, 10 * theta * u.diff(dim=1, prepend=u[:, :1])], -1)
    return x[:, : times.shape[1]]


def test_sensors_have_effects_each_for_itself():
    prior = BoxUniform(torch.ones(1), 3 * torch.ones(1))
    model = SimulatorModel(two_sensors, noise=[0.05, 0.2])
    gen = torch.Generator().manual_seed(0)
    u = torch.randn(6, 20, generator=gen).double().cumsum(1)
    times, truth = torch.arange(20).double(), torch.tensor([[2.0]]).double()
    x = two_sensors(truth, None, inputs={"u": u}, times=times[None])
    x = x + torch.tensor([0.05, 0.2]) * torch.randn(x.shape, generator=gen)
    x[..., 1] += 0.6
    given = {"sample_times": times, "inputs": {"u": u}}
    trials = Trials(None, x, channel_labels=["angle [rad]", "rate [rad/s]"], **given)
    effects = {e.name: e for e in generic_effects(model, trials, prior=prior)}
    assert "bias" not in effects
    sd = [effects[f"{n} bias"].declared_draws().std() for n in ("angle", "rate")]
    assert 3 < float(sd[1] / sd[0]) < 5
    some = [e for n, e in effects.items() if n.endswith(("bias", "sensor lag"))]
    assert Criticism(model, prior, trials, effects=some).trace().verdict == "rate bias"


# Trajectories that are sampled too densely for what the simulator gets wrong


SENSOR = 0.002
TIMES = torch.arange(1, 241) * 0.02
SWINGS = BoxUniform(0.2 * torch.ones(1), 2 * torch.ones(1))
ACTIONS = DiscreteActions(torch.linspace(0.5, 2.0, 6))
BIAS = effect(prior=normal(0.1))


def swing(theta, action):
    return theta * action * (1.3 * TIMES).sin()


def loop(wrong, *, measurement_sd=SENSOR, role=None, **options):
    """Compare a swing with trials that differ by something smooth of some size."""
    noise = AutocorrelatedNoise.unknown(
        sd=(0.5 * SENSOR, 0.5),
        correlation_time=(0.01, 5.0),
        num_sds=20,
        num_times=6,
        measurement_sd=measurement_sd,
    )
    model = SimulatorModel(swing, noise=noise, sample_times=TIMES)
    gen = torch.Generator().manual_seed(0)
    action = ACTIONS.values
    phase = 6 * torch.rand(len(action), 1, generator=gen)
    x = swing(torch.tensor([[0.8]]), action) + wrong * (2.1 * TIMES + phase).sin()
    x = with_error(x, SENSOR, gen)
    trials = Trials(action, x, sample_times=TIMES, role=role)
    options = {"effects": [BIAS], "actions": ACTIONS, **options}
    return Criticism(model, SWINGS, trials, **options)


def test_what_is_smooth_is_thinned_and_said():
    role = ["fit"] * 5 + ["held out"]
    criticism = loop(0.05, role=role)
    every = criticism.sampling.every
    assert 4 <= every <= 30
    assert criticism.sampling.before > 0.5
    kept = criticism.trials.mask
    assert kept[:, every - 1 :: every].all()
    assert int(kept.sum()) == 6 * (240 // every)
    assert len(criticism.rivals.measurements) == 5 * (240 // every)
    report = criticism.report(evaluate=False, plan=False)
    assert [w.code for w in report.warnings].count("SA525") == 1
    # The next trial would be thinned as well.
    x, _ = criticism.trials.template()
    assert int(x.isfinite().sum()) == 240 // every
    assert np.isfinite(report.residuals.refitted[0]).sum() == 240 // every


@pytest.mark.parametrize("options", [{"thin": False}, {"measurement_sd": None}])
def test_nobody_looks_where_it_is_not_asked_for_or_no_sensor_is_declared(options):
    criticism = loop(0.05, **options)
    assert criticism.sampling is None
    assert criticism.trials.mask.all()


def test_what_the_sensor_alone_gets_wrong_is_kept():
    assert loop(0.0).sampling.every == 1


# The rate from which samples say nothing of their own, from known processes


STEP = 0.02


def trials_of(x, step=STEP):
    times = step * torch.arange(1, x.shape[1] + 1).double()
    return Trials(torch.arange(len(x)).double(), x, sample_times=times)


def suggested(trials, x, times=None):
    m = Measurements.of(trials, times)
    return suggested_sampling(m, np.asarray(x).reshape(-1)[m.position])


def smooth(num, length, width, rng):
    """Return a process that is correlated as a Gaussian of a width in samples."""
    at = np.arange(-4 * width, 4 * width + 1)
    kernel = np.exp(-((at / width) ** 2))
    kernel /= np.sqrt((kernel**2).sum())
    white = rng.normal(size=(num, length + len(at) - 1))
    return np.stack([np.convolve(row, kernel, "valid") for row in white])


@pytest.mark.parametrize("rho", [0.0, 0.5, 0.95])
def test_errors_as_assumed_are_kept_all(rho):
    x = autocorrelated(np.random.default_rng(0).normal(size=(8, 300)), rho)
    found = suggested(trials_of(x), x)
    assert found.every == 1
    assert abs(found.before) < 0.1
    assert found.suggested_step == pytest.approx(STEP)


@pytest.mark.parametrize("width", [5, 10])
@pytest.mark.parametrize("seed", [0, 1])
def test_smooth_errors_are_thinned_to_about_their_width(width, seed):
    x = smooth(8, 500, width, np.random.default_rng(seed))
    found = suggested(trials_of(x), x)
    assert 1.0 * width <= found.every <= 2.5 * width
    assert found.before > 0.9
    assert found.after <= 0.2
    # Their correlation is exp(-d^2 / (2 width^2)): as far apart, less than .61.
    other = suggested(trials_of(x, step=1.0), x)
    assert other.every == found.every
    assert other.suggested_step == pytest.approx(found.every)


def test_the_sensor_s_error_on_top_counts_by_its_size():
    rng = np.random.default_rng(0)
    x = 0.3 * smooth(8, 300, 6, rng) + rng.normal(size=(8, 300))
    assert suggested(trials_of(x), x).every == 1
    x = smooth(8, 2_000, 40, rng) + 0.05 * rng.normal(size=(8, 2_000))
    # From sample to sample the smooth one moves by .025, half of the sensor's error.
    assert 40 <= suggested(trials_of(x), x).every <= 100


def test_at_least_eight_samples_are_left():
    x = np.sin(np.arange(40) / 30 + np.arange(6)[:, None])
    assert suggested(trials_of(x), x).every <= 5
    short = x[:, :7]
    assert suggested(trials_of(short), short).every == 1


def test_gaps_several_channels_and_ragged_trials():
    rng = np.random.default_rng(2)
    x = np.stack([smooth(6, 400, 5, rng), 1e3 * smooth(6, 400, 5, rng)], -1)
    x[:, 350:] = np.nan
    x[2, 100:120, 0] = np.nan
    times = STEP * (1 + np.arange(400)) + 0.002 * rng.random((6, 400))
    trials = Trials(torch.arange(6.0), x, sample_times=times)
    assert 5 <= suggested(trials, x).every <= 13
    by_model = Trials(torch.arange(6.0), x)
    assert suggested(by_model, x, times).every <= 13


def test_channels_of_other_rates_and_short_trials_keep_their_own():
    x = torch.full((2, 12, 2), torch.nan)
    x[0, :, 0] = 1.0
    x[0, 1::4, 1] = 2.0  # a slow sensor, between the other's samples
    x[1, :2] = 3.0  # a trial that ended early
    trials = Trials([1.0, 2.0], x, sample_times=torch.arange(12.0))
    few = thinned(trials, Sampling(step=1.0, every=3, before=0.9, after=0.1)).mask
    assert few[0, :, 0].nonzero()[:, 0].tolist() == [2, 5, 8, 11]
    assert few[0, :, 1].nonzero()[:, 0].tolist() == [5, 9]
    assert few[1].nonzero()[:, 0].tolist() == [1, 1]


def test_a_slow_channel_beside_a_fast_one_does_not_hide_it():
    rng = np.random.default_rng(0)
    x = np.full((6, 600, 2), np.nan)
    x[:, :, 0] = smooth(6, 600, 10, rng)
    x[:, 3::50, 1] = rng.normal(size=(6, 12))
    assert 8 <= suggested(trials_of(x), x).every <= 25
    x[:, 3::5, 1] = smooth(6, 600, 10, rng)[:, 3::5]
    assert 4 <= suggested(trials_of(x), x).every <= 25

"""What refutes a verdict: errors left out, held out, and of single trials."""

import math

import numpy as np
import pytest
import torch
from sbi.utils import BoxUniform
from scipy.stats import kstest, norm
from torch.distributions import HalfNormal, Independent, LogNormal

from sbi_active import DiscreteActions, SimulatorModel
from sbi_active.criticism import Criticism, Effect, Trials, close_loop
from sbi_active.criticism.misfit.contrary import unless_refuted
from sbi_active.criticism.misfit.evaluation import evaluate_held_out
from sbi_active.criticism.misfit.record import traced
from sbi_active.criticism.results import NONE
from sbi_active.criticism.steps.detection import LEVEL
from sbi_active.criticism.steps.missed_trials import outlying_trials
from sbi_active.simulation import AutocorrelatedNoise, StudentTNoise, estimate_noise
from tests.criticism.block import DRAG, ROLE, SENSOR, SPEEDS, friction, slid, stop
from tests.criticism.misfit.oscillator import EFFECTS, MODEL, PRIOR
from tests.criticism.misfit.oscillator import trials as oscillations
from tests.criticism.report.reports import misfit
from tests.criticism.report.reports import tracing as reported
from tests.criticism.steps import linear_world as world
from tests.effects import autocorrelated, effect, half, normal, on_outcomes, with_error

# What a verdict rests on


#: Position in meters falls by half, a force in newtons rises by a tenth.
CHANNELS = np.array([0.2, 30.0]), np.array([0.1, 33.0])


#: Errors left out and held out, the sensor, and where one rises.
RAISED = [
    ((1.45, 1.47), (None, None), [0.005], "left-out trials"),
    ((1.45, 1.47), (0.31, 0.3), [0.005], "left-out trials"),
    ((1.45, 1.2), (0.31, 5.2), [0.005], "held-out trials"),
    (CHANNELS, (None, None), [0.1, 1.0], "left-out trials in sensor deviations"),
    (CHANNELS, (None, None), [0.001, 10.0], ""),
]


@pytest.mark.parametrize(("left_out", "held_out", "sensor", "where"), RAISED)
def test_what_raises_an_error_that_is_printed_does_not_help(
    left_out, held_out, sensor, where
):
    found = misfit(left_out, held_out, sensor=sensor)
    made = reported("unexplained", chosen=("drag",), beside=("drag",), misfit=found)
    made = unless_refuted(made, None)
    assert made.refuted_on == where
    if where:
        assert (made.verdict, made.chosen) == ("unexplained", ())
        assert made.misfit.helps == ()


# Fitted trials that err far more than the others, where every model misses


def test_one_that_errs_ten_times_as_much_is_named_and_ordinary_ones_rarely():
    squares = np.random.default_rng(0).chisquare(20, 10)
    squares[4] = 100 * np.median(squares)
    ((place, times),) = outlying_trials([*squares])
    assert (place, times) == (4, pytest.approx(10, rel=0.1))
    assert outlying_trials([1.0, 1.0, 1.0, 1e6]) == []  # too few
    spread = 100 * np.exp(np.random.default_rng(1).normal(0, 1, (1_000, 10)))
    named = [bool(outlying_trials([*own])) for own in spread]
    # A hundredth, and its standard error at 1,000 sets is .003.
    assert np.mean(named) < 0.02


# Held-out trials far outside what a verdict's model predicts, and no others


def report_of(x, action=SPEEDS):
    model = SimulatorModel(stop, noise=SENSOR)
    trials = Trials(action, x, role=ROLE)
    return close_loop(model, friction(0.1), trials, effects=[DRAG], plan=False)


@pytest.fixture(scope="module")
def fitted():
    some = world.rivals(world.measured(curve=0.5))
    return traced(world.judged(some), None)


@pytest.mark.parametrize("drag", [0.0, 0.3])
def test_a_trial_in_another_unit_is_named_first(drag):
    x = slid(drag)
    assert not report_of(x).evaluation.missed
    x[7] *= 100
    report = report_of(x)
    assert report.verdict == ("drag" if drag else NONE)
    assert "held-out trial 7 is far outside it" in str(report).splitlines()[0]
    (missed,) = report.evaluation.missed
    size = float((x[7] - x[7] / 100) / SENSOR)
    assert missed.size == pytest.approx(size, rel=0.01)
    assert missed.by_both
    assert "SA514" in [w.code for w in report.warnings]


def test_the_level_is_that_of_all_held_out_trials(fitted):
    tracing, some = fitted
    trials = Trials(world.ACTION, world.measured(curve=0.5, seed=1))
    named = evaluate_held_out(some, tracing, trials, level=12 * 0.9).missed
    assert 6 <= len(named) <= 12
    assert [*named] == sorted(named, key=lambda trial: -trial.size)


def test_correlated_errors_are_no_contradiction():
    times = torch.linspace(0.05, 2.0, 40)
    model = SimulatorModel(
        lambda theta, action: theta * action * torch.ones(40),
        noise=AutocorrelatedNoise(0.05, correlation_time=1.0),
        sample_times=times,
    )
    prior = BoxUniform(-torch.ones(1), torch.ones(1))
    action = torch.linspace(-1, 1, 10)[:, None]
    for seed in range(3):
        gen = torch.Generator().manual_seed(seed)
        e = autocorrelated(torch.randn(10, 40, generator=gen), float(np.exp(-0.05)))
        trials = Trials(action, 0.5 * action + 0.05 * e, role=ROLE, sample_times=times)
        assert not close_loop(model, prior, trials, plan=False).evaluation.missed


def test_a_measurement_where_the_model_has_none_is_named():
    action = SPEEDS.clone()
    action[8] = 12.0
    (missed,) = report_of(slid(), action).evaluation.missed
    assert (missed.name, missed.size) == ("8", math.inf)


def test_errors_under_misfit_are_compared_with_those_of_left_out_trials():
    action = torch.linspace(0.5, 2.0, 9, dtype=torch.float64)[:, None]
    every = oscillations(lag=0.06, hidden=0.1, action=action)
    role = ["fit", "fit", "held out"] * 3
    for factor, names in ((1.0, []), (100.0, ["5"])):
        x = every.x.clone()
        x[5] *= factor
        trials = Trials(action, x, role=role, sample_times=every.sample_times)
        report = close_loop(MODEL, PRIOR, trials, effects=EFFECTS, plan=False)
        assert report.tracing.misfit is not None
        assert [trial.name for trial in report.evaluation.missed] == names


def test_what_no_model_predicts_refutes_none(fitted):
    tracing, some = fitted
    x = world.measured(curve=0.5, seed=1)
    mean, _ = world.posterior(world.measured(curve=0.5), ("curve",))
    side = np.sign(world.columns(("curve",))[0, 2] * mean[2])
    x[0] -= 1e4 * float(side)  # nearer the bare
    evaluation = evaluate_held_out(some, tracing, Trials(world.ACTION, x))
    rmse = evaluation.table.set_index("metric").loc["rmse"]
    assert rmse["after"] > rmse["before"]
    assert [trial.position for trial in evaluation.missed if trial.by_both] == [0]
    assert unless_refuted(tracing, evaluation).verdict == "curve"


def test_the_tail_is_that_of_the_normal_predictive(fitted):
    tracing, some = fitted
    x = world.measured(curve=0.5, seed=1)
    x[5] = x[5] + 0.8
    (missed,) = evaluate_held_out(some, tracing, Trials(world.ACTION, x)).missed
    mean, covariance = world.posterior(world.measured(curve=0.5), ("curve",))
    design = world.columns(("curve",))[5]
    sd = np.sqrt(design @ covariance @ design + world.NOISE**2)
    z = abs(float(x[5]) - design @ mean) / sd
    assert np.log(missed.p_value) == pytest.approx(np.log(2 * norm.sf(z)), rel=0.2)


# Alarms, and effects that no permitted action tells apart


def detected(x, noise=world.SENSOR):
    return world.judged(world.rivals(x, noise=noise)).detection


def test_the_chi_square_alone_raises_the_alarm_where_the_noise_is_known():
    signs = torch.tensor([1.0, -1.0] * 6)[:, None]  # no effect takes these up
    x = 0.8 * world.ACTION + 1.5 * world.NOISE * signs
    found = detected(x)
    assert found.p_value < LEVEL
    assert not found.by_evidence
    assert found.alarm
    repeats = 0.1 * torch.randn(6, 1, generator=torch.Generator().manual_seed(0))
    for noise in (estimate_noise(repeats), StudentTNoise(0.1, df=4.0)):
        assert detected(x, noise).level == 0.0


def test_the_chi_square_of_clean_data_is_one():
    bare = [world.rivals(world.measured(seed=k)).with_effects(()) for k in range(24)]
    p = [world.judged(some).detection.p_value for some in bare]
    assert kstest(p, "uniform").pvalue > 0.01


# Effects without a derivative at their null are not taken for none


TIMES = torch.linspace(0, 1, 21)
STEP = 0.05
SWINGS = BoxUniform(torch.tensor([0.2, 0.5]), torch.tensor([1.5, 4.0]))
SIZES = DiscreteActions(torch.linspace(0.5, 2.0, 6))
TRUE = torch.tensor([[0.8, 2.0]])


def swing(theta, action):
    """A swing whose size depends on theta in a bend."""
    return action * theta[:, :1].exp() * torch.sin(theta[:, 1:] * TIMES.to(theta))


def held(x, phi, action, context):
    """A lag that takes whole steps alone."""
    late = (phi[:, 0] / STEP).round().long()
    places = (torch.arange(x.shape[1]) - late[:, None]).clamp_min(0)
    return x.gather(1, places)


def rounded(x, phi, action, context):
    """A quantum: nothing where it is far below the last digit."""
    quantum = phi.clamp_min(1e-3)
    return torch.where(phi > 1e-3, (x / quantum).round() * quantum, x)


def dead(action, phi, commanded, context):
    """An actuator that stands still below its smallest action."""
    return torch.where(action.abs() < phi + 0.4, torch.zeros_like(action), action)


def late(x, phi, action, context):
    """What shows beyond all permitted actions alone."""
    return x + phi * (action > 3)


def scaled(x, phi, action, context):
    """What the first parameter does as well, at any size."""
    return x * phi.exp()


def loop(*effects, x=None, fn=swing):
    model = SimulatorModel(fn, noise=0.05, sample_times=TIMES)
    action = SIZES.values[[0, 2, 4, 1, 5, 3]]
    x = with_error(swing(TRUE, action) if x is None else x, 0.05)
    trials = Trials(action, x, sample_times=TIMES)
    return Criticism(model, SWINGS, trials, effects=effects, actions=SIZES)


FLAT = [
    effect("held", apply=held, prior=half(2 * STEP)),
    effect("rounded", apply=rounded, prior=half(0.5)),
    effect("dead", apply=dead, prior=half(0.8), hook="action"),
]


@pytest.mark.parametrize("flat", FLAT, ids=lambda e: e.name)
def test_what_is_flat_at_its_null_is_not_none(flat):
    coarse = lambda theta, action: swing(theta, action).round(decimals=2)  # noqa: E731
    assert loop(flat, fn=coarse if flat.name == "rounded" else swing).equivalent() == ()


@pytest.mark.parametrize(
    "hidden", [on_outcomes("late", late), on_outcomes("scaled", scaled, 0.3)]
)
def test_what_shows_nowhere_or_is_a_parameter_is_none(hidden):
    assert loop(hidden).equivalent() == (frozenset({"none", hidden.name}),)


def test_a_lag_that_is_held_over_steps_raises_the_alarm_and_is_named():
    action = SIZES.values[[0, 2, 4, 1, 5, 3]]
    x = held(swing(TRUE, action), torch.full((6, 1), 3 * STEP), action, None)
    criticism = loop(*FLAT, x=x)
    assert criticism.detect().by_evidence
    assert criticism.trace().verdict == "held"
    assert not any("held" in group for group in criticism.trace().equivalent)


# Two effects that are alike near their null, and further off may not be


STAMPS = torch.linspace(0, 3, 31)
FREQUENCIES = DiscreteActions(torch.linspace(0.5, 3.0, 6))
GAIN = LogNormal(torch.zeros(1), torch.tensor([0.3]))


LATE = {
    "delay": Effect.keyword("delay", prior=half(0.2)),
    "lag": Effect.keyword("lag", prior=half(0.2)),
    "clock": Effect.keyword("clock", prior=normal(0.2)),
    # Late, and with a second strength that shows nowhere.
    "two": Effect.keyword(
        *("two", "delay", "unused"),
        prior=Independent(HalfNormal(torch.tensor([0.2, 1.0])), 1),
    ),
}


def respond(theta, action, *, delay=0.0, lag=0.0, clock=0.0, unused=0.0):
    """Return the answer to a sine of frequency action, late by a delay or by a lag."""
    late, tau, early = (
        (torch.as_tensor(v) + torch.zeros(len(theta))).double()[:, None]
        for v in (delay, lag, clock)
    )
    w = action.double()
    phase = w * (STAMPS - late + early.expm1()) - torch.atan(w * tau)
    size = theta.double() / (1 + (w * tau) ** 2).sqrt()
    return (size * torch.sin(phase)).to(theta.dtype)


#: Effects, and those of them that are alike.
PAIRS = [
    # Both have the derivative of x, and a lag is smaller at high frequencies.
    (("delay", "lag"), None),
    (("lag", "two"), None),
    # 1 - exp(-t) takes the place of a delay t.
    (("delay", "clock"), ("delay", "clock")),
    (("lag", "delay", "clock"), ("delay", "clock")),
    (("two", "clock"), ("two", "clock")),
]


@pytest.mark.parametrize(("names", "pair"), PAIRS)
def test_effects_that_are_alike_near_zero_alone_are_told_apart(names, pair):
    model = SimulatorModel(respond, noise=0.02, sample_times=STAMPS)
    action = FREQUENCIES.values
    x = with_error(respond(torch.ones(6, 1), action), 0.02)
    trials = Trials(action, x, sample_times=STAMPS)
    given = {"effects": [LATE[n] for n in names], "actions": FREQUENCIES}
    found = Criticism(model, Independent(GAIN, 1), trials, **given).equivalent()
    assert found == (() if pair is None else (frozenset(pair),))

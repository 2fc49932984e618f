"""What refutes a verdict: errors left out, held out, and of single trials."""

import math

import numpy as np
import pytest
import torch
from sbi.utils import BoxUniform
from scipy.stats import norm

from sbi_active import AutocorrelatedNoise, GaussianNoise, SimulatorModel
from sbi_active.criticism import Trials, close_loop
from sbi_active.criticism.misfit.contrary import unless_refuted
from sbi_active.criticism.misfit.evaluation import evaluate_held_out
from sbi_active.criticism.misfit.record import traced
from sbi_active.criticism.results import NONE
from sbi_active.criticism.steps.missed_trials import outlying_trials
from tests.criticism.block import DRAG, ROLE, SENSOR, SPEEDS, friction, slid, stop
from tests.criticism.misfit.oscillator import EFFECTS, MODEL, PRIOR
from tests.criticism.misfit.oscillator import trials as oscillations
from tests.criticism.report.reports import misfit
from tests.criticism.report.reports import tracing as reported
from tests.criticism.steps import linear_world as world
from tests.effects import autocorrelated

# What a verdict rests on


#: Position in meters falls by half, a force in newtons rises by a tenth.
CHANNELS = np.array([0.2, 30.0]), np.array([0.1, 33.0])


@pytest.mark.parametrize(
    ("left_out", "held_out", "sensor", "where"),
    [
        ((1.45, 1.47), (None, None), [0.005], "left-out trials"),
        ((1.45, 1.47), (0.31, 0.3), [0.005], "left-out trials"),
        ((1.45, 1.2), (0.31, 5.2), [0.005], "held-out trials"),
        (CHANNELS, (None, None), [0.1, 1.0], "left-out trials in sensor deviations"),
        (CHANNELS, (None, None), [0.001, 10.0], ""),
    ],
)
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
    model = SimulatorModel(stop, noise=GaussianNoise(SENSOR))
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
    x[0] += (
        1e4 if world.columns(("curve",))[0, 2] * mean[2] < 0 else -1e4
    )  # nearer the bare
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

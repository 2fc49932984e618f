"""The closed loop where every model misses by more than the sensor's error."""

import numpy as np
import pytest
import torch
from scipy.stats import multivariate_normal

from sbi_active import DiscreteActions, SimulatorModel
from sbi_active.criticism import Criticism, Trials, close_loop
from sbi_active.criticism.linear.mixture import summed
from sbi_active.criticism.linear.screening import linear_models
from sbi_active.criticism.misfit import record
from sbi_active.criticism.misfit.guesses import MARGIN, guess_residual
from sbi_active.criticism.results import ModelKey
from sbi_active.criticism.steps.detection import THRESHOLD
from sbi_active.simulation import AutocorrelatedNoise
from tests.criticism.misfit.oscillator import (
    ACTION,
    EFFECTS,
    MODEL,
    PRIOR,
    SENSOR,
    TIMES,
    trials,
)
from tests.criticism.misfit.oscillator import trials as recorded
from tests.criticism.steps.linear_world import ACTION as NUMBERS
from tests.criticism.steps.linear_world import NOISE, judged, measured, rivals
from tests.effects import on_outcomes

HIDDEN, LAG = 0.6, 0.3


def loop(own, effects=EFFECTS, model=MODEL, **options):
    return Criticism(model, PRIOR, own, effects=effects, seed=0, **options)


@pytest.fixture(scope="module")
def named():
    """Trials with lag, beside a force that nobody declared."""
    return loop(trials(lag=LAG, hidden=HIDDEN))


def test_the_cause_is_named_beside_what_nobody_declared(named):
    tracing = named.trace()
    assert tracing.verdict == "lag"
    assert tracing.misfit.support["lag"].inclusion > 0.9
    assert tracing.misfit.support["lag"].better > 0.9
    bare, own = tracing.misfit.of("none"), tracing.misfit.of(tracing.model)
    assert own.left_out[0] < 0.5 * bare.left_out[0]
    assert own.remains < 0.5
    assert own.left_out[0] > 1.5 * SENSOR  # the hidden force is there
    assert not tracing.misfit.passes
    assert named.set_aside == ()  # no trial errs far more than the others


def test_without_the_effect_in_the_library_nothing_takes_its_place(named):
    found = loop(trials(lag=LAG, hidden=HIDDEN), EFFECTS[:2]).trace()
    assert found.verdict == "unexplained"
    assert found.misfit.named == ()


@pytest.mark.parametrize("effects", [{}, {"friction": 0.2}])
def test_a_model_that_fits_to_the_sensor_needs_none_of_it(effects):
    found = loop(trials(**effects))
    assert found.misfit() is None
    assert found.trace().verdict == (" + ".join(effects) or "none")


def test_one_trial_with_a_gross_error_is_no_misfit():
    own = trials()
    own.x[3] += 20 * SENSOR
    found = loop(own)
    assert found.misfit() is None
    assert found.trace().verdict == "outlier"


def test_the_order_of_effects_and_trials_does_not_matter(named):
    own = trials(lag=LAG, hidden=HIDDEN)
    turned = loop(own.select([*range(7, -1, -1)]), EFFECTS[::-1]).trace()
    same = named.trace()
    assert {*turned.chosen} == {*same.chosen}
    assert {*turned.misfit.named} == {*same.misfit.named}
    for name, own in same.misfit.support.items():
        remains = turned.misfit.support[name].remains
        assert remains == pytest.approx(own.remains, abs=0.05)


def test_held_out_trials_are_scored_for_every_admitted_model():
    action = torch.cat([ACTION, torch.tensor([[0.8], [1.7]], dtype=torch.float64)])
    every = trials(action=action, lag=LAG, hidden=HIDDEN)
    own = Trials(
        every.action,
        every.x,
        sample_times=every.sample_times,
        role=["fit"] * 8 + ["held out"] * 2,
    )
    report = close_loop(MODEL, PRIOR, own, effects=EFFECTS, seed=0)
    bare = report.tracing.misfit.of("none").held_out
    after = report.tracing.misfit.of(report.tracing.model).held_out
    assert after[0] < 0.6 * bare[0]
    assert "on held-out trials from" in " ".join(str(report).split())
    # Both by the best fit, whose parameters the evidence has.
    rmse = report.evaluation.table.set_index("metric").loc["rmse"]
    assert rmse["before"] == pytest.approx(bare[0], rel=1e-6)
    theta = torch.from_numpy(report.tracing.evidences["none"].best)[None]
    x = MODEL.fn(theta.expand(2, -1), action[8:]).double()
    error = (x - every.x[8:]).square().mean().sqrt()
    assert float(error) == pytest.approx(bare[0], rel=1e-4)


def test_the_sensor_has_an_error_in_each_channel():
    """The lag is that of the first sensor, in its own unit."""
    units = torch.tensor([1.0, 100.0], dtype=torch.float64)

    def fn(theta, action, *, lag=0.0):
        x = MODEL.fn(theta, action, lag=lag)
        return torch.stack([x, MODEL.fn(theta, action)], -1) * units

    noise = AutocorrelatedNoise(
        SENSOR * units, 1e-3, measurement_sd=(SENSOR * units).tolist()
    )
    model = SimulatorModel(
        fn, noise=noise, batched=True, sample_times=MODEL.sample_times
    )
    one, other = trials(lag=LAG, hidden=HIDDEN).x, trials(seed=1, hidden=HIDDEN).x
    own = Trials(
        ACTION, torch.stack([one, 100 * other], -1), sample_times=MODEL.sample_times
    )
    found = loop(own, [EFFECTS[2]], model).trace()
    assert found.misfit.sensor == pytest.approx([SENSOR, 100 * SENSOR])
    bare, after = (found.misfit.of(name).left_out for name in ("none", "lag"))
    assert after[0] < 0.7 * bare[0]
    assert 100 * SENSOR < after[1] < bare[1]


# One trial that errs far more than the others, where every model misses


SLIP = 1.0


def loop_of(own):
    return Criticism(MODEL, PRIOR, own, effects=EFFECTS[2:], seed=0)


def test_it_is_named_and_has_no_part_in_the_verdict():
    own = recorded(lag=0.3, hidden=0.6)
    x = own.x.clone()
    x[3] += SLIP * torch.sin(3 * TIMES)
    made = loop_of(Trials(ACTION, x, sample_times=TIMES))
    report = made.report(plan=False, evaluate=False)
    assert [trial.name for trial in report.tracing.set_aside] == ["3"]
    assert "trial 3 is set aside" in str(report).splitlines()[0]
    assert any("trial 3 is far outside" in w for w in report.warnings)
    others = [k for k in range(len(own)) if k != 3]
    alone = loop_of(own.select(others)).trace()
    assert report.tracing.verdict == alone.verdict
    assert report.tracing.probabilities == alone.probabilities
    lines = str(report).split("By trial")[1].splitlines()
    assert next(line for line in lines if "set aside" in line).split()[0] == "3"


def test_ordinary_misfit_sets_nothing_aside():
    found = loop_of(recorded(lag=0.3, hidden=0.6))
    assert found.misfit() is not None
    assert found.set_aside == ()


# Effects that the noise hides from each other


SIZE = 0.5
X = measured(curve=SIZE)
ACTIONS = DiscreteActions(torch.linspace(-2, 2, 12))
PAIR = frozenset({"curve", "twin"})


def like_the_verdict(some, actions):
    found = judged(some)
    tracing, _ = record.traced(found, None, near=False)
    return record.like_the_verdict(found, tracing, actions)


def twin(distance):
    """Return the curve with a wave of a root mean square, in noise deviations."""
    size = distance * NOISE / SIZE * 2**0.5
    return on_outcomes(
        "twin",
        lambda x, phi, action, context: (
            x + phi * (action**2 - 1 + size * torch.sin(5 * action))
        ),
    )


def test_effects_closer_than_the_noise_are_nearly_the_same():
    assert like_the_verdict(rivals(X, twin(0.3)), ACTIONS) == (PAIR,)


def test_effects_apart_by_more_over_the_permitted_actions_are_not():
    # Between the trials at hand they hardly differ; beyond them they do.
    other = on_outcomes(
        "twin",
        lambda x, phi, action, context: (
            x + phi * (action**2 - 1 + torch.relu(action.abs() - 2) ** 3)
        ),
    )
    some = rivals(X, other)
    assert like_the_verdict(some, None) == (PAIR,)
    assert like_the_verdict(some, DiscreteActions(torch.linspace(-4, 4, 12))) == ()


def test_an_effect_that_the_trials_refute_is_not_like_the_verdict():
    assert like_the_verdict(rivals(X), ACTIONS) == ()
    # Closer than the noise, and yet refuted by these trials.
    some = rivals(measured(curve=SIZE, seed=4), twin(0.95))
    states = judged(rivals(measured(curve=SIZE, seed=4), twin(0.95))).states
    curve, other = (states.log_evidence(ModelKey((n,))) for n in ("curve", "twin"))
    assert curve - other > THRESHOLD
    assert like_the_verdict(some, ACTIONS) == ()


# What the residual follows where no declared effect helps


FEW = [e for e in EFFECTS if e.name in ("friction", "bias")]


def few_effects(own):
    return Criticism(MODEL, PRIOR, own, effects=FEW, seed=0)


def slope(x):
    return torch.gradient(x, spacing=0.2, dim=1)[0]


@pytest.mark.parametrize(
    ("change", "hidden", "formula"),
    [(lambda x: 0.15 * x**2, 0.05, "x^2"), (lambda x: -0.1 * slope(x), 0.3, "x'")],
)
def test_what_the_sensor_does_is_guessed(change, hidden, formula):
    own = trials(hidden=hidden)
    own.x += change(own.x)
    found = few_effects(own)
    tracing = found.trace()
    assert tracing.misfit is not None
    assert tracing.chosen == ()
    name, gain = tracing.guesses[0]
    assert name == formula
    assert gain > 5
    assert found.report(evaluate=False, plan=False).guess == formula


def searched(further):
    """A search of the bare model of trials without a time axis."""
    some = rivals(measured(further=further))
    search, _ = linear_models(some)
    return search


def test_a_guess_is_the_term_that_is_missing_of_numbers():
    found = guess_residual(searched(0.8 * NUMBERS**3))
    assert found[0][0] == "xi^3"
    assert min(gain for _, gain in found) > MARGIN


def test_what_no_formula_is_of_numbers_has_no_guess():
    assert guess_residual(searched(2 * torch.sin(9 * NUMBERS))) == ()
    assert guess_residual(searched(0 * NUMBERS)) == ()


def test_the_evidence_of_the_residual_process_is_that_of_its_covariances():
    """Against normal densities of what the linear model leaves, all summed out."""
    search = searched(0.8 * NUMBERS**3)
    model, rivals = search.found[ModelKey()].model, search.rivals
    at = np.ones(len(rivals.measurements), dtype=bool)
    process = rivals.residual_process(rivals.noise, at)
    prior = model.jacobian @ np.diag(model.sd**2) @ model.jacobian.T
    mean = model.residual + model.jacobian @ (model.center - model.u)
    num = len(mean)
    whiteners, log_weight = process.grams(np.diag(search.unit))
    log_p = [
        multivariate_normal(np.zeros(num), prior + np.linalg.inv(precision)).logpdf(
            mean
        )
        for precision in whiteners
    ]
    # The weights hold the constants of the densities in the process's metric.
    volume = 0.5 * np.linalg.slogdet(whiteners)[1] - 0.5 * num * np.log(2 * np.pi)
    log_weight = log_weight + np.log(search.unit).sum() - volume
    assert np.logaddexp.reduce(log_weight) == pytest.approx(0, abs=1e-6)
    exact = np.logaddexp.reduce(np.array(log_p) + log_weight)
    assert not np.isfinite(model.low).any()
    every = np.ones(search.errors.num_folds, dtype=bool)
    found = summed(*search.smooth(model, every), model).log_evidence
    assert found == pytest.approx(exact, abs=1e-6)

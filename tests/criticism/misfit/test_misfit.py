"""The closed loop where every model misses by more than the sensor's error."""

import numpy as np
import pytest
import torch
from torch.distributions import Normal

from sbi_active import SimulatorModel
from sbi_active.criticism import Criticism, Effect, Trials, close_loop
from sbi_active.criticism.linear.screening import linear_models
from sbi_active.criticism.misfit import record
from sbi_active.criticism.misfit.guesses import MARGIN, guess_residual
from sbi_active.criticism.results import ModelKey
from sbi_active.criticism.rivals.trial_simulator import TrialSimulator
from sbi_active.criticism.steps.detection import THRESHOLD
from sbi_active.criticism.steps.predictive import conditioned, find_residuals, predict
from tests.criticism.misfit.oscillator import (
    ACTION,
    EFFECTS,
    MODEL,
    PRIOR,
    SENSOR,
    TIMES,
    trials,
)
from tests.criticism.steps.linear_world import ACTION as NUMBERS
from tests.criticism.steps.linear_world import NOISE, judged, measured, rivals
from tests.criticism.steps.linear_world import PRIOR as WIDE
from tests.effects import added

HIDDEN, LAG = 0.6, 0.3


def loop(own, effects=EFFECTS, model=MODEL, prior=PRIOR, **options):
    return Criticism(model, prior, own, effects=effects, seed=0, **options)


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
    without = loop(named.trials, EFFECTS[:2]).trace()  # nothing takes its place
    assert without.verdict == "unexplained"
    assert without.misfit.named == ()


@pytest.mark.parametrize("effects", [{}, {"friction": 0.2}])
def test_a_model_that_fits_to_the_sensor_needs_none_of_it(effects):
    found = loop(trials(**effects))
    assert found.trace().misfit is None
    assert found.trace().verdict == (" + ".join(effects) or "none")


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
    role = ["fit"] * 8 + ["held out"] * 2
    own = Trials(action, every.x, sample_times=TIMES, role=role)
    report = close_loop(MODEL, PRIOR, own, effects=EFFECTS, seed=0, plan=False)
    bare = report.tracing.misfit.of("none").held_out
    after = report.tracing.misfit.of(report.tracing.model).held_out
    assert after[0] < 0.6 * bare[0]
    # Both by the best fit, whose parameters the evidence has.
    rmse = report.evaluation.table.set_index("metric").loc["rmse"]
    assert rmse["before"] == pytest.approx(bare[0], rel=1e-6)
    theta = torch.from_numpy(report.tracing.evidences["none"].best)[None]
    error = MODEL.fn(theta.expand(2, -1), action[8:]) - every.x[8:]
    assert float(error.square().mean().sqrt()) == pytest.approx(bare[0], rel=1e-4)


def test_held_out_errors_are_told_number_by_number_as_left_out_ones_are():
    """Two numbers in units of their own: their errors have no common size."""
    unit, gen = torch.tensor([1.0, 100.0]), torch.Generator().manual_seed(3)

    def both(theta, action):
        return (theta[:, :1] + theta[:, 1:] * action) * unit

    action = 4 * torch.rand(24, 1, generator=gen) - 2
    x = both(torch.tensor([[1.0, 0.5]]), action)
    x = x + unit * (0.8 * action**2 + 0.4 * torch.sin(4 * action))
    x = x + 0.05 * unit * torch.randn(x.shape, generator=gen)
    own = Trials(action, x, role=["fit"] * 16 + ["held out"] * 8)
    model = SimulatorModel(both, noise=0.05 * unit)
    curve = added("curve", lambda xi: xi**2 * unit)
    for found in loop(own, [curve], model, prior=WIDE).trace().misfit.models:
        held_out = found.held_out / unit.numpy()
        assert held_out.max() < 2 * held_out.min()
        assert found.left_out.shape == found.held_out.shape


# Predictions where every model misses: those of the linear model that was fitted


def test_residuals_are_those_of_the_best_fit(named):
    """Draws as wide as the misfit leave the valley that parameters make up for."""
    key, search = named.trace().key, named._verdict.search
    left = find_residuals(named.rivals, key)
    own = (left.x - left.mean).ravel()[search.errors.measurements.position]
    assert own == pytest.approx(search.unit * search.model(key).residual, abs=1e-6)


# One trial that errs far more than the others, where every model misses


def test_a_trial_that_errs_far_more_is_named_and_has_no_part_in_the_verdict():
    own = trials(lag=0.3, hidden=0.6)
    own.x[3] += torch.sin(3 * TIMES)
    report = loop(own, EFFECTS[2:]).report(plan=False, evaluate=False)
    assert [trial.name for trial in report.tracing.set_aside] == ["3"]
    assert "SA513" in [w.code for w in report.warnings]
    others = [k for k in range(len(own)) if k != 3]
    alone = loop(own.select(others), EFFECTS[2:]).trace()
    assert report.tracing.verdict == alone.verdict
    assert report.tracing.probabilities == alone.probabilities


# Effects that the noise hides from each other


SIZE = 0.5
X = measured(curve=SIZE)
PAIR = frozenset({"curve", "twin"})


def aliases(some):
    return record.traced(judged(some), None)[0].aliases


def twin(distance):
    """Return the curve with a wave of a root mean square, in noise deviations."""
    size = distance * NOISE / SIZE * 2**0.5
    return added("twin", lambda xi: xi**2 - 1 + size * torch.sin(5 * xi))


def test_effects_closer_than_the_noise_are_nearly_the_same():
    assert aliases(rivals(X, twin(0.3))) == (PAIR,)


def test_an_effect_that_the_trials_refute_is_not_like_the_verdict():
    assert aliases(rivals(X)) == ()
    # Closer than the noise, and yet refuted by these trials.
    some = rivals(measured(curve=SIZE, seed=4), twin(0.95))
    evidence = judged(some).states.log_evidence
    curve, other = (evidence(ModelKey((name,))) for name in ("curve", "twin"))
    assert curve - other > THRESHOLD
    assert aliases(some) == ()


# What the residual follows where no declared effect helps


def guesses(further):
    """Return what the residual follows of the bare model of numbers without times."""
    return guess_residual(linear_models(rivals(measured(further=further)))[0])


def test_a_guess_is_the_term_that_is_missing_of_numbers_and_none_where_no_formula_is():
    found = guesses(0.8 * NUMBERS**3)
    assert found[0][0] == "xi^3"
    assert min(gain for _, gain in found) > MARGIN
    assert guesses(2 * torch.sin(9 * NUMBERS)) == guesses(0 * NUMBERS) == ()


# Start states that every trial has anew, beside an effect and an undeclared force


NUM, NUM_HELD, FIRST = 12, 4, 7
START = Effect.keyword("start", prior=Normal(0.0, 0.5), scope="trial")
BESIDE = [START, *EFFECTS[2:]]


@pytest.fixture(scope="module")
def started():
    rng = np.random.default_rng(1)
    action = torch.from_numpy(rng.uniform(1, 4, (NUM + NUM_HELD, 1)))
    start = torch.from_numpy(rng.normal(0, 0.5, NUM + NUM_HELD))
    every = trials(action=action, lag=0.3, hidden=0.3, start=start)
    role = ["fit"] * NUM + ["held out"] * NUM_HELD
    own = Trials(action, every.x, sample_times=TIMES, role=role)
    return loop(own, BESIDE, warm_up=1.25), own


def test_the_cause_is_found_beside_start_states(started):
    criticism, _ = started
    assert criticism.trace().verdict == "lag"
    evidence = criticism.trace().evidences["lag"]
    assert evidence.effective_sample_size >= 50
    assert evidence.draws.shape[1] == 3  # theta and lag, no start states


def test_a_held_out_trial_tells_of_its_start_by_its_first_samples(started):
    criticism, own = started
    tracing, held = criticism.trace(), own.held_out
    error = tracing.misfit.of(tracing.model).held_out[0]
    blind = loop(own, BESIDE)
    far = blind.trace().misfit.of(blind.trace().model).held_out[0]
    assert error < 0.5 * far
    # What was used to find the start is not scored.
    p = predict(criticism.rivals, held, key=ModelKey(("lag",)))
    assert len(p.measurements) == NUM_HELD * (20 - FIRST)
    assert {int(i) % 20 for i in p.measurements.position} == {*range(FIRST, 20)}


def test_start_states_are_those_of_least_squares(started):
    """Drawn given the first samples, against a search over the start alone."""
    criticism, own = started
    criticism.trace()
    rivals = criticism.rivals
    fit = rivals.fit(ModelKey(("lag",)))
    simulator = TrialSimulator(rivals.simulator.model, own.held_out)
    rng = np.random.default_rng(0)
    theta, phi = conditioned(rivals, fit, fit.sample.u[:40], simulator, rng)
    grid = torch.linspace(-2, 2, 2001, dtype=torch.float64)
    middle = theta.double().reshape(-1, 2).mean(0).expand(len(grid), -1)
    for t, drawn in enumerate(phi["start"][..., 0].T.numpy()):
        action = own.held_out.action[t].expand(len(grid), -1)
        lag = float(phi["lag"].mean())
        x = MODEL.fn(middle, action, start=grid, lag=lag)
        square = ((x - own.held_out.x[t])[:, :FIRST] ** 2).sum(1)
        best = float(grid[int(square.argmin())])
        assert drawn.mean() == pytest.approx(best, abs=4 * drawn.std() + 0.01)
        assert drawn.std() < 0.1

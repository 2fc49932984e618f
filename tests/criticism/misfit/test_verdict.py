"""Verdicts over force dictionaries by linear evidence, on a pendulum with a truth."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from sbi.utils import BoxUniform
from torch.distributions import Independent, Normal

from sbi_active import DiscreteActions, GaussianNoise, SimulatorModel
from sbi_active.criticism import Criticism, Effect, Trials
from sbi_active.criticism.forces import force_effects
from sbi_active.criticism.misfit.contrary import beyond_bounds
from sbi_active.criticism.results import NONE, SCATTER, UNEXPLAINED, ModelKey
from sbi_active.criticism.steps.detection import REFUTED
from tests.criticism import block, slope_world
from tests.criticism.block import DRAG, GAIN, ROLE, SPEEDS, friction, slid, stop
from tests.criticism.forces.test_forces import MODEL, PRIOR, SD, measured
from tests.criticism.misfit.oscillator import EFFECTS, SENSOR, TIMES, oscillate
from tests.criticism.misfit.oscillator import MODEL as OSCILLATOR
from tests.criticism.misfit.oscillator import PRIOR as RATES
from tests.criticism.misfit.oscillator import trials as oscillations
from tests.effects import BIAS, added, louder


@pytest.fixture(scope="module")
def loop():
    hidden = measured("sin 2q", 0.5, seed=1)
    effects = force_effects(MODEL, PRIOR, hidden, joints=["hinge"])[::6]
    return Criticism(MODEL, PRIOR, hidden, effects=effects, seed=0)


def test_a_verdict_takes_a_few_thousand_simulated_trials(loop):
    tracing = loop.trace()
    assert len(tracing.chosen) == 1
    in_q = {e.name for e in loop.effects if e.family == "force in q of hinge"}
    assert tracing.verdict in in_q
    assert sum(p for k, p in tracing.probabilities.items() if k in in_q) > 0.9
    assert loop.rivals.simulator.num_simulations < 10_000
    assert tracing.evidences[tracing.verdict].engine == "linear"
    assert tracing.p_value > 0.01
    assert loop.detect().alarm


def test_the_error_falls_on_left_out_trials_or_the_verdict_is_withdrawn(loop):
    evaluation = loop.evaluate()
    rmse = evaluation.table.set_index("metric").loc["rmse"]
    assert rmse["after"] < min(0.6 * rmse["before"], 1.5 * SD)
    assert all(name.endswith("of hinge") for name in evaluation.selected)
    assert loop.judged(evaluation).chosen == loop.trace().chosen
    table = evaluation.table.copy()
    table.loc[table["metric"] == "rmse", "after"] = 1.01 * rmse["before"]
    judged = loop.judged(replace(evaluation, table=table))
    assert judged.chosen == ()
    assert judged.verdict == UNEXPLAINED
    assert judged.instead_of == loop.trace().verdict


@pytest.mark.parametrize("finer", [1, 10])
def test_a_small_bias_is_named_however_fine_the_sensor_is_declared(finer):
    """It leaves most of the squares, which are the sensor's."""
    noise = GaussianNoise(SENSOR / finer)
    model = SimulatorModel(oscillate, noise=noise, sample_times=TIMES)
    own = oscillations(bias=1.2 * SENSOR)
    tracing = Criticism(model, RATES, own, effects=EFFECTS).trace()
    assert tracing.verdict == "bias"
    assert (tracing.misfit is not None) == (finer > 1)


def test_what_is_asked_first_does_not_matter():
    """Residuals before or after the verdict, and a report made twice, are the same."""
    own = oscillations(bias=0.05, hidden=0.4)
    one, other = (Criticism(OSCILLATOR, RATES, own, effects=EFFECTS) for _ in "ab")
    early, tracing = one.residuals(), one.trace()
    assert other.trace().probabilities == tracing.probabilities
    assert np.array_equal(other.residuals().refitted, early.refitted, equal_nan=True)
    told = [one.report(evaluate=False, plan=False) for _ in "ab"]
    assert str(told[0]) == str(told[1])


def test_likely_models_that_bend_have_samples_of_their_posterior():
    """Of two gains in a row trials tell the product, on a hyperbola."""
    model = SimulatorModel(lambda theta, a: theta.prod(1, keepdim=True) * a, noise=0.5)
    action = torch.linspace(-1, 3, 8, dtype=torch.float64)[:, None]
    error = torch.as_tensor(np.random.default_rng(4).standard_normal((8, 1)))
    trials = Trials(action, 4 * action + 2 + 0.5 * error)
    prior = BoxUniform(torch.zeros(2), 5 * torch.ones(2))
    loop = Criticism(model, prior, trials, effects=[BIAS], seed=0)
    tracing = loop.trace()
    assert tracing.verdict == "bias"
    assert tracing.evidences["scatter"].engine == "linear"
    own = tracing.evidences["bias"]
    assert own.engine in ("importance", "smc")
    assert own.draws[:, :2].std(0).min() > 0.5
    # Seven standard errors of the slope beside a bias, .135, for all 400 draws.
    assert own.draws[:, 0] * own.draws[:, 1] == pytest.approx(4.0, abs=1.0)
    linear = loop._verdict.states.log_evidence(ModelKey(("bias",)))
    assert own.log_evidence == linear  # asked by one, drawn by the other
    # Left-out trials are predicted along the hyperbola, as by the line without them.
    line = np.concatenate([action, torch.ones_like(action)], 1)
    hat = line @ np.linalg.pinv(line)
    error = (trials.x - hat @ trials.x.numpy()).numpy()[:, 0] / (1 - np.diag(hat))
    rmse = loop.evaluate().table.set_index("metric").loc["rmse"]
    assert rmse["after"] == pytest.approx(np.sqrt((error**2).mean()), rel=0.2)


def scattered(size, *effects, num=16, seed=1):
    """A loop on numbers without a time axis, of errors with some size each."""
    action = torch.linspace(-2, 2, num, dtype=torch.float64)[:, None]
    draws = torch.Generator().manual_seed(seed)
    error = torch.randn(num, 1, generator=draws, dtype=torch.float64)
    trials = Trials(action, action + size(action) * error)
    given = slope_world.MODEL, slope_world.PRIOR, trials
    return Criticism(*given, effects=effects, seed=0)


LOUDER = louder(lambda phi, action: phi[:, :1] * action.abs(), 2.0)


def test_outcomes_are_told_however_large_the_library():
    """A ball that flies too far is not seen, without a time axis."""

    def seen(theta, action):
        x = theta * action
        return x.where(x.abs() < 3, torch.nan)

    effects = [
        added(f"turned {k}", lambda a, k=k: torch.cos(k * a), 0.5, hook="action")
        for k in range(25)
    ]
    action = torch.linspace(-2, 2, 20, dtype=torch.float64)[:, None]
    error = torch.randn(20, 1, generator=torch.manual_seed(0)).double()
    trials = Trials(action, seen(2.0, action + 0.4 * torch.cos(3 * action)) + error / 9)
    model = SimulatorModel(seen, noise=1 / 9)
    prior = BoxUniform(torch.zeros(1), 5 * torch.ones(1))
    loop = Criticism(model, prior, trials, effects=effects)
    assert loop.rivals.can_fail
    assert loop.trace().verdict == "turned 3"


#: Sizes of errors, effects, and the verdict.
LARGER = [
    (lambda action: 0.5, [BIAS], SCATTER),
    (lambda action: 0.1 + 0.3 * action.abs(), [BIAS, LOUDER], "louder"),
]


@pytest.mark.parametrize(("size", "effects", "verdict"), LARGER)
def test_a_larger_noise_is_chosen_again_without_each_trial(size, effects, verdict):
    """Left-out trials do not refute it, and what it lets expect is not left over."""
    loop = scattered(size, *effects)
    tracing = loop.trace()
    assert tracing.verdict == verdict
    assert tracing.evidences[verdict].engine == "linear"
    evaluation = loop.evaluate()
    assert evaluation.selected.count(verdict) > 12
    rows = evaluation.table.set_index("metric")
    assert rows.loc["log predictive density", "ratio"] > 1
    assert loop.judged(evaluation).verdict == verdict
    if tracing.chosen:
        assert tracing.p_value > REFUTED


def test_a_set_with_an_effect_on_the_noise_has_draws_for_the_next_action():
    loop = scattered(lambda action: 0.1 + 0.3 * action.abs(), BIAS, LOUDER)
    tracing = loop.trace()
    both = "bias + louder"
    assert tracing.probabilities[both] > 0.01
    assert tracing.evidences[both].draws.shape[1] == 3
    actions = DiscreteActions(torch.linspace(-2, 2, 5))
    assert loop.next_action(actions).candidates.shape == (5, 1)


def test_left_out_trials_of_a_few_that_scatter_have_errors_as_large():
    """Without one of seven trials the others may not show that they scatter."""
    covered = []
    for seed in range(6):
        loop = scattered(lambda action: 0.3, num=7, seed=seed)
        if loop.trace().verdict == "scatter":
            covered.append(loop.evaluate().after["coverage"].mean())
    assert len(covered) >= 3
    # Of 21 trials or more, with three standard errors; it was below .75.
    assert np.mean(covered) >= 0.76


# Parameters at bounds of the prior


SHARES = torch.linspace(0.1, 1.0, 10)


def slide(theta, action, **effects):
    """Return the share of the way that is covered at some times."""
    return stop(theta, action, **effects) * (1 - torch.exp(-3 * SHARES))


def criticism(prior, *, effect=GAIN, fn=stop, drag=0.0):
    times = SHARES if fn is slide else None
    given = {"parameter_names": ["friction"], "sample_times": times}
    model = SimulatorModel(fn, noise=block.SENSOR, **given)
    trials = Trials(SPEEDS, slid(drag, fn), role=ROLE, sample_times=times)
    return Criticism(model, prior, trials, effects=[effect], seed=0)


def beyond(loop, tracing):
    loop.trace()
    return beyond_bounds(loop._verdict, loop.rivals, tracing)


def codes(report):
    return {w.code for w in report.warnings}


@pytest.mark.parametrize("fn", [stop, slide])
def test_an_effect_that_a_wider_prior_makes_up_for_is_not_named(fn):
    """A prior that begins at .5, where friction is .4."""
    report = criticism(friction(0.5), fn=fn).report(plan=False)
    assert report.tracing.chosen == ()
    assert report.verdict == UNEXPLAINED
    assert report.tracing.instead_of == "gain"
    bounds = report.tracing.bounds
    found = bounds.parameters[0]
    assert (found.name, found.model, found.side) == ("friction", NONE, "lower")
    assert found.bound == pytest.approx(0.5)
    assert found.beyond == pytest.approx(0.4, abs=0.005)
    assert bounds.p_value > 0.01
    assert "SA103" in codes(report)
    assert "SA518" not in codes(report)  # it is explained


def test_a_cause_that_no_bound_makes_up_for_stays_named():
    report = criticism(friction(0.1, 0.42), effect=DRAG, drag=0.3).report(plan=False)
    assert report.verdict == "drag"
    assert report.tracing.bounds.replaces == ""
    (found,) = report.tracing.bounds.parameters
    assert (found.model, found.side) == (NONE, "upper")
    assert found.beyond > 0.42
    assert "SA103" in codes(report)


def test_a_narrow_prior_without_bounds_names_nothing_either():
    tight = Independent(Normal(torch.full((1,), 0.5), 0.01), 1)
    tracing = criticism(tight).report(plan=False).tracing
    assert tracing.chosen == ()
    assert tracing.verdict in (NONE, UNEXPLAINED)


def test_a_bound_of_phi_is_told_and_its_null_is_none():
    prior = BoxUniform(torch.zeros(1), torch.full((1,), 0.1))
    strong = Effect.keyword("drag", prior=prior)
    loop = criticism(friction(0.1), effect=strong, drag=0.3)
    assert loop.trace().chosen == ("drag",)
    tracing = beyond(loop, replace(loop.trace(), chosen=("drag",)))
    # Asked first of all, it has the posteriors as well.
    first = criticism(friction(0.1), effect=strong, drag=0.3).judged(None)
    assert first.bounds.parameters
    (found,) = [p for p in tracing.bounds.parameters if p.name == "drag"]
    assert (found.model, found.side) == ("drag", "upper")
    assert found.beyond > 0.15
    weak = criticism(friction(0.1), effect=Effect.keyword("drag", prior=prior))
    told = beyond(weak, replace(weak.trace(), chosen=("drag",)))
    assert told.bounds.parameters == ()


def test_a_simulator_that_refuses_what_is_beyond_is_asked_no_more():
    def refusing(theta, action, **effects):
        if (theta < 0.5).any():
            raise ValueError("expected friction of at least 0.5")
        return stop(theta, action, **effects)

    loop = criticism(friction(0.5))
    loop.trace()
    loop.rivals.simulator.model.base.fn = refusing
    found = beyond(loop, loop.trace())
    (only,) = found.bounds.parameters
    assert np.isnan(only.beyond)
    assert np.isnan(found.bounds.p_value)


@pytest.mark.parametrize(("low", "is_said"), [(0.403, True), (0.1, False)])
def test_a_bare_model_that_explains_at_its_bound_says_so(low, is_said):
    report = criticism(friction(low)).report(plan=False)
    assert report.verdict == NONE
    told = report.tracing.bounds.parameters
    assert ("SA103" in codes(report)) == is_said == bool(told)

"""Probabilities, verdicts and scores, against the closed forms of a linear world."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.stats import norm

from sbi_active.criticism import Trials
from sbi_active.criticism.misfit.evaluation import evaluate_held_out, evaluate_left_out
from sbi_active.criticism.misfit.record import traced
from sbi_active.criticism.results import ModelKey
from sbi_active.criticism.rivals.rival_set import RivalSet
from sbi_active.criticism.steps.predictive import find_residuals
from tests.criticism.steps import linear_world as world
from tests.effects import added


def tracing_of(x):
    found = world.judged(world.rivals(x))
    return traced(found, None)[0], found


@pytest.mark.parametrize(
    "phi",
    [{}, {"curve": 0.12}, {"curve": 0.14, "kink": 0.32}, {"wave": 0.1}],
    ids=" ".join,
)
def test_evidences_are_exact_and_what_they_say_is_chosen(phi):
    x = world.measured(**phi)
    found = world.judged(world.rivals(x))
    for key in found.choice.probabilities:
        # Beside the sensor's error alone, in densities of its deviations.
        exact = world.log_evidence(x, key.effects) + len(x) * np.log(world.NOISE)
        # There several effects have scales of their own.
        error = 0.2 + 0.5 * (len(key.effects) > 1)
        assert found.states.log_evidence(key) == pytest.approx(exact, abs=error)
        beside = [p for own, p in found.states.keys(key).items() if own != key]
        assert np.exp(beside) == pytest.approx([0.1, 0.1, 0.1])
    assert sum(found.probabilities.values()) == pytest.approx(1)
    chosen = traced(found, None)[0].chosen
    assert chosen == ((*phi,) if found.detection.alarm else ())


def test_estimates_are_those_of_each_effect_alone():
    x = world.measured(curve=0.3)
    tracing, found = tracing_of(x)
    null = world.log_evidence(x)
    for name in tracing.effects:
        own = tracing.evidences[name]
        phi, phi_sd = own.moments[name]
        mean, covariance = world.posterior(x, (name,))
        sd = covariance[-1, -1] ** 0.5
        error = 4 * sd * np.sqrt(2 / 400)
        if found.misses(ModelKey((name,))):
            assert abs(phi - mean[-1]) < phi_sd
            assert phi_sd > 2 * sd
        else:
            assert phi == pytest.approx(mean[-1], abs=error)
            assert phi_sd == pytest.approx(sd, abs=error)
        factor = world.log_evidence(x, (name,)) - null
        gain = own.log_evidence - tracing.evidences["none"].log_evidence
        assert gain == pytest.approx(factor, abs=0.3)
    assert max(tracing.inclusion, key=tracing.inclusion.get) == "curve"


def test_without_an_alarm_there_is_nothing_to_trace():
    tracing, _ = tracing_of(world.measured())
    assert tracing.verdict == "none"
    assert tracing.chosen == tracing.needed == ()
    # No trial is suspected, and no set of several effects is looked for.
    assert tracing.outliers == {}
    assert not any(" + " in name for name in tracing.probabilities)


def test_what_an_effect_leaves_over_is_unexplained_beside_it():
    """A wave that nobody declared, whose error the intervals hold."""
    x = world.measured(curve=1.0, further=0.4 * torch.sin(1.7 * world.ACTION + 1))
    tracing, found = tracing_of(x)
    assert found.key.error in ("unexplained", "scatter")
    misfit = tracing.misfit
    assert tracing.chosen == misfit.named == ("curve",)
    assert not misfit.passes
    # One of about twenty formulas is the effect: their mean is log(20) = 3 nats below.
    assert -4 < misfit.support["curve"].guessed < 0
    draws = tracing.evidences["curve"].draws
    assert (abs(draws.mean(0) - (0.3, 0.8, 1.0)) < 3 * draws.std(0)).all()


def test_a_formula_that_does_better_leaves_an_imitation_unnamed():
    """A power of 1.5 is not declared; the curve takes up 99 % of its excess."""
    tracing, _ = tracing_of(world.measured(further=4 * world.ACTION.abs() ** 1.5))
    misfit = tracing.misfit
    assert "curve" in misfit.helps
    assert misfit.support["curve"].remains < 0.02
    assert misfit.support["curve"].guessed > 10
    assert misfit.named == ()
    assert tracing.guesses[0][0] == "|xi|^1.5"


def test_effects_that_the_trials_do_not_separate_count_as_one():
    twin = added("twin", lambda xi: 0.5 * (xi**2 - 1), family="dynamics")
    group = frozenset({"curve", "twin"})
    tracing, _ = traced(
        world.judged(world.rivals(world.measured(curve=0.1, kink=0.28), twin), [group]),
        None,
    )
    assert tracing.equivalent == (group,)
    assert tracing.verdict == max(group, key=tracing.probabilities.__getitem__)


def test_the_credible_set_has_nine_tenths_of_the_probability_and_no_more_names():
    tracing, _ = tracing_of(world.measured(curve=0.14, kink=0.2))
    p, num = tracing.probabilities, len(tracing.credible_set)
    least, less = (sum(sorted(p.values())[-k:]) for k in (num, num - 1))
    assert sum(p[n] for n in tracing.credible_set) == pytest.approx(least)
    assert num > 1
    assert less < 0.9 <= least


# Sets of several effects, against all sets of a linear world


def test_a_name_may_contain_what_joins_names():
    x = world.measured(curve=0.5, kink=0.6)
    shapes = world.rivals(x).effects
    renamed = [replace(e, name=f"{n} + {n} lag") for n, e in shapes.items()]
    trials = Trials(world.ACTION, x)
    some = RivalSet(world.rivals(x).model, world.PRIOR, trials, renamed)
    tracing, _ = traced(world.judged(some), None)
    assert tracing.chosen == ("curve + curve lag", "kink + kink lag")
    assert tracing.model == "curve + curve lag + kink + kink lag"
    assert tracing.inclusion["wave + wave lag"] < 0.2


# Residuals and scores on further trials, in closed form


X = world.measured(curve=0.5)
OTHERS = world.measured(curve=0.5, seed=1)


def predictive(x, names, known=slice(None)):
    """Return mean and deviation of a measurement at each of the twelve actions."""
    mean, covariance = world.posterior(x, names, known)
    design = world.columns(names)
    variance = np.einsum("ni,ij,nj->n", design, covariance, design)
    return design @ mean, np.sqrt(variance + world.NOISE**2)


def norm_crps(x, mean, sd):
    """Return the energy score of a normal prediction of one number."""
    z = (x - mean) / sd
    return sd * (z * (2 * norm.cdf(z) - 1) + 2 * norm.pdf(z) - 1 / np.sqrt(np.pi))


@pytest.fixture(scope="module")
def fitted():
    return traced(world.judged(world.rivals(X)), None)


def check_scores(scores, own, mean, sd):
    """Compare scores with those of normal predictions of one number."""
    density = norm(mean, sd).logpdf(own)
    np.testing.assert_allclose(scores["rmse"], np.abs(own - mean), atol=0.02)
    found = scores["log predictive density"]
    np.testing.assert_allclose(found, density, rtol=0.2, atol=0.1)
    crps = norm_crps(own, mean, sd)
    np.testing.assert_allclose(scores["energy score"], crps, atol=0.02)
    assert (scores["coverage"] != (np.abs(own - mean) < 1.645 * sd)).sum() <= 1


@pytest.mark.parametrize("scheme", ["held out", "leave one out"])
def test_scores_before_and_after_are_those_of_the_normal_predictives(fitted, scheme):
    tracing, some = fitted
    own = OTHERS if scheme == "held out" else X
    if scheme == "held out":
        made = evaluate_held_out(some, tracing, Trials(world.ACTION, own))
    else:
        found = world.judged(world.rivals(X))
        trials = Trials(world.ACTION, own)
        made = evaluate_left_out(found, found.rivals, trials, num_draws=2000)
    for scores, names in ((made.before, ()), (made.after, ("curve",))):
        mean, sd = predictive(X, names)
        if scheme != "held out":
            each = [predictive(X, names, np.arange(12) != t) for t in range(12)]
            mean, sd = np.array([(m[t], s[t]) for t, (m, s) in enumerate(each)]).T
        check_scores(scores, own[:, 0].double().numpy(), mean, sd)
    assert made.scheme == scheme
    assert made.selected == 12 * ("curve",)


def test_errors_of_some_trials_are_those_of_a_verdict_on_them():
    """A smooth function of the action is one of them; without it scatter took over."""
    x, keep = world.measured(curve=0.1), np.arange(12) != 4
    whole = world.judged(world.rivals(x)).states.joint(ModelKey(), keep)
    less = world.judged(world.rivals(x[keep], action=world.ACTION[keep]))
    part = less.states.joint(ModelKey())
    assert [*whole] == [*part]
    for key, log_p in part.items():
        assert whole[key] == pytest.approx(log_p, abs=0.3), key


@pytest.mark.parametrize("names", [(), ("curve",)])
def test_residuals_are_standardized_by_the_normal_predictive(fitted, names):
    made = find_residuals(fitted[1], ModelKey(names))
    mean, sd = predictive(X, names)
    own = X[:, 0].double().numpy()
    np.testing.assert_allclose(made.mean[:, 0], mean, atol=0.02)
    np.testing.assert_allclose(made.sd[:, 0], sd, rtol=0.1)
    expected = (own - made.mean[:, 0]) / made.sd[:, 0]
    np.testing.assert_allclose(made.refitted[:, 0], expected, rtol=1e-6)
    assert made.noise == "declared"
    assert made.correlation == 0


@pytest.mark.parametrize("phi", [{}, {"curve": 0.3}], ids=["scatter", "curve"])
def test_intervals_of_a_model_that_misses_know_it(phi):
    """Whichever model explains: its posterior beside the sensor's error does not."""
    noise = torch.randn(12, 1, generator=torch.Generator().manual_seed(1))
    x = world.measured(further=0.0 if phi else 4 * world.NOISE * noise, **phi)
    tracing, found = tracing_of(x)
    assert tracing.verdict == " ".join(phi) or found.key.error == "scatter"
    mean, covariance = world.posterior(x, ())
    draws = tracing.evidences["none"].draws
    assert (draws.std(0) > 2 * np.sqrt(np.diag(covariance))).all()
    assert tracing.evidences["none"].best == pytest.approx(mean, abs=0.02)

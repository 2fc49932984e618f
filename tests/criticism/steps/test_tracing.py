"""Probabilities and verdicts, against the exact evidences of a linear world."""

from itertools import combinations

import numpy as np
import pytest
import torch
from torch.distributions import Normal

from sbi_active.criticism import Effect
from sbi_active.criticism.misfit.record import traced
from sbi_active.criticism.results import ModelKey
from sbi_active.criticism.steps.tracing import log_prior, log_priors
from tests.criticism.steps import linear_world
from tests.criticism.steps.linear_world import (
    ACTION,
    NOISE,
    SHAPES,
    effect,
    judged,
    measured,
    rivals,
)


def tracing_of(x, **keywords):
    found = judged(rivals(x))
    return traced(found, None, **keywords)[0], found


def test_families_share_what_none_leaves():
    log_p = log_priors([effect(name) for name in SHAPES])
    p = {name: np.exp(value) for name, value in log_p.items()}
    assert p == pytest.approx(
        {"none": 0.5, "curve": 1 / 8, "wave": 1 / 8, "kink": 1 / 4}
    )


@pytest.mark.parametrize(
    "phi",
    [{}, {"curve": 0.12}, {"curve": 0.14, "kink": 0.32}, {"wave": 0.1}],
    ids=" ".join,
)
def test_probabilities_are_priors_times_evidences(phi):
    x = measured(**phi)
    found = judged(rivals(x))
    states, prior = found.states, log_priors(found.rivals.library)
    log_p = {}
    for key in found.choice.probabilities:
        of_set = log_prior(key.effects, prior) if key.effects else prior["none"]
        for own, of_state in states.keys(key).items():
            log_p[own] = of_set + of_state + states.log_evidence(own)
            # Without a time axis a second effect has to gain a Bayes factor of five.
            log_p[own] -= np.log(5) * (len(key.effects) > 1)
        # Beside the sensor's error alone, in densities of its deviations.
        exact = linear_world.log_evidence(x, key.effects) + len(x) * np.log(NOISE)
        # There several effects have scales of their own.
        several = len(key.effects) > 1
        assert states.log_evidence(key) == pytest.approx(exact, abs=0.2 + 0.5 * several)
        beside = [p for own, p in states.keys(key).items() if own != key]
        assert np.exp(beside) == pytest.approx([0.1, 0.1, 0.1])
    total = np.logaddexp.reduce([*log_p.values()])
    expected = {}
    for own, value in log_p.items():
        name = str(ModelKey(own.effects) if own.effects else own)
        expected[name] = expected.get(name, 0.0) + np.exp(value - total)
    told = {str(key): p for key, p in found.probabilities.items()}
    assert sum(told.values()) == pytest.approx(1)
    assert {k: p for k, p in told.items() if p > 0} == pytest.approx(expected)
    chosen = traced(found, None)[0].chosen
    assert chosen == ((*phi,) if found.detection.alarm else ())


def test_estimates_are_those_of_each_effect_alone():
    x = measured(curve=0.3)
    tracing, _ = tracing_of(x)
    null = linear_world.log_evidence(x)
    for estimate in tracing.estimates:
        mean, covariance = linear_world.posterior(x, (estimate.name,))
        sd = covariance[-1, -1] ** 0.5
        error = 4 * sd * np.sqrt(1 / 400 + 1 / estimate.effective_sample_size)
        assert estimate.mean == pytest.approx(mean[-1:], abs=error)
        assert estimate.sd == pytest.approx([sd], abs=error)
        factor = linear_world.log_evidence(x, (estimate.name,)) - null
        assert estimate.log_bayes_factor == pytest.approx(factor, abs=0.3)
    shares = [estimate.probability for estimate in tracing.estimates]
    assert shares == sorted(shares, reverse=True)
    assert tracing.estimates[0].name == "curve"


def test_without_an_alarm_there_is_nothing_to_trace():
    tracing, _ = tracing_of(measured())
    assert tracing.verdict == "none"
    assert tracing.chosen == ()
    assert tracing.needed == ()
    # No trial is suspected, and no set of several effects is looked for.
    assert tracing.outliers == {}
    assert not any(" + " in name for name in tracing.probabilities)


def test_what_an_effect_leaves_over_is_unexplained_beside_it():
    x = measured(curve=2.0, further=3 * NOISE * torch.sin(1.7 * ACTION + 1))
    tracing, found = tracing_of(x)
    assert found.key.error in ("unexplained", "scatter")
    assert tracing.chosen == ("curve",)
    assert not tracing.misfit.passes


@pytest.mark.parametrize(
    ("phi", "robust"), [({"curve": 0.065}, False), ({"curve": 0.5}, True), ({}, True)]
)
def test_a_verdict_that_hangs_on_the_width_of_a_prior_is_not_robust(phi, robust):
    assert tracing_of(measured(**phi))[0].robust == robust


def test_effects_that_the_trials_do_not_separate_count_as_one():
    twin = Effect(
        "twin",
        hook="observation",
        family="dynamics",
        prior=Normal(0.0, 1.0),
        null=0.0,
        apply=lambda x, phi, action, context: x + 0.5 * phi * (action**2 - 1),
    )
    x = measured(curve=0.1, kink=0.28)
    group = frozenset({"curve", "twin"})
    found = judged(rivals(x, twin), [group])
    tracing, _ = traced(found, None)
    assert group in tracing.near
    assert tracing.equivalent == (group,)
    p = tracing.probabilities
    assert tracing.verdict == max(group, key=p.__getitem__)


@pytest.mark.parametrize("kink", [0.2, 0.32])
def test_inclusion_and_the_credible_set_add_probabilities_up(kink):
    tracing, _ = tracing_of(measured(curve=0.14, kink=kink))
    p = tracing.probabilities
    for name, total in tracing.inclusion.items():
        parts = [p[k] for k, e in tracing.evidences.items() if name in e.key.effects]
        assert total == pytest.approx(sum(parts))
    num = len(tracing.credible_set)
    sums = [sum(p[n] for n in names) for names in combinations(p, num)]
    assert sum(p[n] for n in tracing.credible_set) == pytest.approx(max(sums))
    assert max(sums) >= 0.9
    assert max(sum(p[n] for n in names) for names in combinations(p, num - 1)) < 0.9

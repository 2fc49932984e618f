"""Probabilities and verdicts, against the exact evidences of a linear world."""

from itertools import combinations

import numpy as np
import pytest
import torch
from torch.distributions import Normal

from sbi_active.criticism import Effect
from sbi_active.criticism.linear.screening import linear_models
from sbi_active.criticism.misfit.linear_evidence import LinearEvidence
from sbi_active.criticism.results import CATCH_ALLS, ModelKey
from sbi_active.criticism.steps.combinations import log_prior
from sbi_active.criticism.steps.tracing import log_priors, trace
from tests.criticism.steps import linear_world
from tests.criticism.steps.linear_world import (
    ACTION,
    NOISE,
    SHAPES,
    effect,
    measured,
    rivals,
)


def linear(x, *further, groups=()):
    """The evidence of linear models, which in this world is exact."""
    some = rivals(x, *further)
    return LinearEvidence(linear_models(some)[0], some, groups)


def traced(x, **keywords):
    found = linear(x)
    return trace(found, found.detected(), **keywords), found


def test_families_share_what_none_and_the_catch_alls_leave():
    log_p = log_priors([effect(name) for name in SHAPES])
    p = {name: np.exp(value) for name, value in log_p.items()}
    assert p == pytest.approx(
        {
            **{"none": 0.5, "unexplained": 0.05, "scatter": 0.05, "outlier": 0.05},
            **{"curve": 0.35 / 4, "wave": 0.35 / 4, "kink": 0.35 / 2},
        }
    )
    two = log_priors([effect("kink")], ("unexplained", "scatter"))
    assert np.exp(two["kink"]) == pytest.approx(0.4)
    assert sum(np.exp([*two.values()])) == pytest.approx(1)


@pytest.mark.parametrize(
    "phi",
    [{"curve": 0.12}, {"curve": 0.14, "kink": 0.32}, {"wave": 0.1}],
    ids=" ".join,
)
def test_probabilities_are_priors_times_evidences(phi):
    x = measured(**phi)
    tracing, found = traced(x)
    assert sum(tracing.probabilities.values()) == pytest.approx(1)
    prior = log_priors(found.rivals.library)
    exact = {"none": linear_world.log_evidence(x) + prior["none"]}
    for name in tracing.probabilities:
        if name in CATCH_ALLS:
            exact[name] = found.log_evidence(ModelKey(error=name)) + prior[name]
            exact[name] -= len(x) * np.log(NOISE)  # densities of sensor deviations
        elif name != "none":
            key = tracing.evidences[name].key
            names = key.effects
            of_set = log_prior(names, prior) if len(names) > 1 else prior[name]
            exact[name] = linear_world.log_evidence(x, names) + of_set
            # The record has the evidence that the probability rests on.
            kept = tracing.evidences[name].log_evidence
            assert kept == found.log_evidence(key)
    total = np.logaddexp.reduce([*exact.values()])
    close = [name for name, value in exact.items() if value > total - 15]
    assert len(close) > 3
    # Each effect beyond the first may imitate something undeclared.
    for name in tracing.evidences:
        further = len(tracing.evidences[name].key.effects) - 1
        exact[name] += max(further, 0) * np.log(0.85)
    rest = total - np.logaddexp.reduce([*exact.values()])
    exact["unexplained"] = total + np.log(
        np.exp(exact["unexplained"] - total) - np.expm1(-rest)
    )
    for name, p in tracing.probabilities.items():
        if name in close:
            assert np.log(p) == pytest.approx(exact[name] - total, abs=0.3)
        else:
            assert p < 1e-5


def test_estimates_are_those_of_each_effect_alone():
    x = measured(curve=0.3)
    tracing, _ = traced(x)
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
    tracing, _ = traced(measured())
    assert tracing.verdict == "none"
    assert tracing.chosen == ()
    assert tracing.needed == ()
    # No trial is suspected, and no set of several effects is looked for.
    assert {*tracing.probabilities} == {"none", "unexplained", "scatter", *SHAPES}
    assert tracing.outliers == {}


def test_what_an_effect_leaves_over_is_unexplained_beside_it():
    x = measured(curve=2.0, further=3 * NOISE * torch.sin(1.7 * ACTION + 1))
    tracing, found = traced(x)
    assert tracing.verdict == "unexplained"
    assert tracing.chosen == ()
    assert tracing.beside == ("curve",)
    # The process alone or with the effect, half and half.
    alone = found.log_evidence(ModelKey(error="unexplained"))
    rest = found.log_with_process(ModelKey(("curve",)))
    prior = log_priors(found.rivals.library)
    expected = np.logaddexp(alone, rest) - np.log(2) + prior["unexplained"]
    expected -= found.log_evidence(ModelKey(("curve",))) + prior["curve"]
    p = tracing.probabilities
    assert np.log(p["unexplained"] / p["curve"]) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("phi", "robust"), [({"curve": 0.08}, False), ({"curve": 0.5}, True), ({}, True)]
)
def test_a_verdict_that_hangs_on_the_width_of_a_prior_is_not_robust(phi, robust):
    assert traced(measured(**phi), compare=False)[0].robust == robust


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
    found = linear(x, twin, groups=[group])
    tracing = trace(found, found.detected())
    assert group in tracing.near
    assert tracing.equivalent == (group,)
    p = tracing.probabilities
    assert tracing.credible_set[0] == "unexplained"
    assert p["curve"] + p["twin"] > p["unexplained"]
    assert tracing.verdict == max(group, key=p.__getitem__)


@pytest.mark.parametrize("kink", [0.2, 0.32])
def test_inclusion_and_the_credible_set_add_probabilities_up(kink):
    tracing, _ = traced(measured(curve=0.14, kink=kink), compare=False)
    p = tracing.probabilities
    for name, total in tracing.inclusion.items():
        parts = [p[k] for k, e in tracing.evidences.items() if name in e.key.effects]
        assert total == pytest.approx(sum(parts))
    num = len(tracing.credible_set)
    sums = [sum(p[n] for n in names) for names in combinations(p, num)]
    assert sum(p[n] for n in tracing.credible_set) == pytest.approx(max(sums))
    assert max(sums) >= 0.9
    assert max(sum(p[n] for n in names) for names in combinations(p, num - 1)) < 0.9

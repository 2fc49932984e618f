"""Draws of models that the trials refute."""

import numpy as np
import pytest

from sbi_active.criticism.results import Estimate, Evidence, ModelKey, Tracing
from sbi_active.criticism.steps.refuted import widened

RNG = np.random.default_rng(0)


def evidence(key, names, center, log_z, square):
    draws = np.array(center) + 0.01 * RNG.normal(size=(4_000, len(names)))
    return Evidence(
        key=key,
        log_evidence=log_z,
        standard_error=0.0,
        effective_sample_size=4_000.0,
        engine="least squares",
        names=names,
        draws=draws,
        best_chi_square=square,
    )


def anywhere(key, z):
    return z


def tracing(*found, chosen=("a",), estimates=()):
    return Tracing(
        verdict=" + ".join(chosen),
        chosen=chosen,
        probabilities={},
        inclusion={},
        credible_set=(),
        equivalent=(),
        near=(),
        aliases=(),
        estimates=estimates,
        evidences={e.name: e for e in found},
        robust=True,
    )


BARE = evidence(ModelKey(), ("theta",), [2.0], -100.0, 400.0)


BEST = evidence(ModelKey(("a",)), ("theta", "a"), [1.0, 0.3], 0.0, 25.0)


OTHER = evidence(ModelKey(("b",)), ("theta", "b"), [1.5, 0.7], -50.0, 100.0)


def test_a_refuted_model_is_spread_as_far_as_what_explains_moves_it():
    found = widened(tracing(BARE, BEST, OTHER), 0, anywhere).evidences
    assert found["none"].draws.mean() == pytest.approx(2.0, abs=0.05)
    # Four times as wide by the chi-squares, and a deviation of one apart.
    assert found["none"].draws.std() == pytest.approx(1.0, rel=0.05)
    # What the best model does not have is as far as before.
    assert found["b"].draws.std(0) == pytest.approx([0.5, 0.02], rel=0.06)
    assert found["a"] is BEST


def test_draws_stay_within_the_prior_and_estimates_follow_them():
    estimate = Estimate(
        name="b",
        family="sensor",
        units="m",
        describe="",
        probability=0.0,
        log_bayes_factor=50.0,
        mean=OTHER.draws[:, 1:].mean(0),
        sd=OTHER.draws[:, 1:].std(0),
        effective_sample_size=4_000.0,
        engine="least squares",
    )
    found = widened(
        tracing(BEST, OTHER, estimates=(estimate,)),
        0,
        lambda key, z: np.clip(z, [1.2, 0.0], [1.6, 0.71]),
    )
    draws = found.evidences["b"].draws
    assert (draws.min(0) >= [1.2, 0.0]).all()
    assert (draws.max(0) <= [1.6, 0.71]).all()
    told = found.estimates[0]
    assert told.mean == pytest.approx(draws[:, 1:].mean(0))
    assert told.sd == pytest.approx(draws[:, 1:].std(0))
    assert told.sd > 1.2 * estimate.sd

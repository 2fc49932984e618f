"""Residuals and scores on further trials, in closed form."""

import numpy as np
import pytest
from scipy.stats import norm

from sbi_active.criticism import Trials
from sbi_active.criticism.misfit.evaluation import evaluate_held_out, evaluate_left_out
from sbi_active.criticism.misfit.record import traced
from sbi_active.criticism.results import ModelKey
from sbi_active.criticism.steps.predictive import find_residuals
from tests.criticism.steps.linear_world import (
    ACTION,
    NOISE,
    columns,
    judged,
    measured,
    posterior,
    rivals,
)

X = measured(curve=0.5)
OTHERS = measured(curve=0.5, seed=1)


def predictive(x, names, known=slice(None)):
    """Return mean and deviation of a measurement at each of the twelve actions."""
    mean, covariance = posterior(x, names, known)
    design = columns(names)
    variance = np.einsum("ni,ij,nj->n", design, covariance, design)
    return design @ mean, np.sqrt(variance + NOISE**2)


def crps(x, mean, sd):
    """Return the energy score of a normal prediction of one number."""
    z = (x - mean) / sd
    return sd * (z * (2 * norm.cdf(z) - 1) + 2 * norm.pdf(z) - 1 / np.sqrt(np.pi))


@pytest.fixture(scope="module")
def fitted():
    some = rivals(X)
    return traced(judged(some), None)


def test_scores_before_and_after_are_those_of_the_normal_predictives(fitted):
    tracing, some = fitted
    made = evaluate_held_out(some, tracing, Trials(ACTION, OTHERS))
    own = OTHERS[:, 0].double().numpy()
    for scores, names in ((made.before, ()), (made.after, ("curve",))):
        mean, sd = predictive(X, names)
        inside = np.abs(own - mean) < 1.645 * sd
        np.testing.assert_allclose(scores["rmse"], np.abs(own - mean), atol=0.02)
        np.testing.assert_allclose(
            scores["energy score"], crps(own, mean, sd), atol=0.02
        )
        np.testing.assert_allclose(
            scores["log predictive density"], norm(mean, sd).logpdf(own), rtol=0.2
        )
        assert (scores["coverage"] != inside).sum() <= 1
    assert made.scheme == "held out"
    assert made.selected == 12 * ("curve",)


def test_each_trial_is_predicted_from_the_others():
    found = judged(rivals(X))
    own = Trials(ACTION, X)
    made = evaluate_left_out(found, found.models, own, num_draws=2000)
    own = X[:, 0].double().numpy()
    for scores, names in ((made.before, ()), (made.after, ("curve",))):
        each = [predictive(X, names, np.arange(12) != t) for t in range(12)]
        mean, sd = np.array([(m[t], s[t]) for t, (m, s) in enumerate(each)]).T
        np.testing.assert_allclose(scores["rmse"], np.abs(own - mean), atol=0.02)
        np.testing.assert_allclose(
            scores["log predictive density"],
            norm(mean, sd).logpdf(own),
            rtol=0.2,
            atol=0.1,
        )
    assert made.scheme == "leave one out"
    assert made.selected == 12 * ("curve",)


def test_errors_of_some_trials_are_those_of_a_verdict_on_them():
    """A smooth function of the action is one of them; without it scatter took over."""
    x, keep = measured(curve=0.1), np.arange(12) != 4
    whole = judged(rivals(x)).states.joint(ModelKey(), keep)
    part = judged(rivals(x[keep], action=ACTION[keep])).states.joint(ModelKey())
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
    np.testing.assert_allclose(
        made.refitted[:, 0], (own - made.mean[:, 0]) / made.sd[:, 0], rtol=1e-6
    )
    assert made.noise == "declared"
    assert made.correlation == 0

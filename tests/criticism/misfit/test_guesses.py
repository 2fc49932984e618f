"""What the residual follows where no declared effect helps."""

import numpy as np
import pytest
import torch
from scipy.stats import multivariate_normal

from sbi_active.criticism import Criticism
from sbi_active.criticism.linear.mixture import summed
from sbi_active.criticism.linear.screening import linear_models
from sbi_active.criticism.misfit.guesses import MARGIN, guess_residual
from sbi_active.criticism.results import ModelKey
from tests.criticism.misfit.oscillator import EFFECTS, MODEL, PRIOR, trials
from tests.criticism.steps.linear_world import ACTION, measured, rivals

FEW = [e for e in EFFECTS if e.name in ("friction", "bias")]


def loop(own):
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
    found = loop(own)
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
    found = guess_residual(searched(0.8 * ACTION**3))
    assert found[0][0] == "xi^3"
    assert min(gain for _, gain in found) > MARGIN


def test_what_no_formula_is_of_numbers_has_no_guess():
    assert guess_residual(searched(2 * torch.sin(9 * ACTION))) == ()
    assert guess_residual(searched(0 * ACTION)) == ()


def test_the_evidence_of_the_residual_process_is_that_of_its_covariances():
    """Against normal densities of what the linear model leaves, all summed out."""
    search = searched(0.8 * ACTION**3)
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

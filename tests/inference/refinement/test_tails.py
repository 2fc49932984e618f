"""Tail probabilities of the observations are those of further simulations."""

import numpy as np
import pytest
import torch
from scipy.stats import binom, chi2
from torch.distributions import MultivariateNormal

from sbi_active.inference import RefinementOptions, refine
from sbi_active.inference.refinement.checks import _exceedance, _held_out, _squares
from sbi_active.inference.regression import surrogate
from sbi_active.inference.regression.regions import whole_space
from sbi_active.inference.regression.surrogate import LocalRegression, estimate_noise

NUM_ROWS, NUM_TRIALS = 120, 2


def outcomes(rng, z, num_numbers, correlation):
    """Linear in z, with noise that correlates along the numbers of a trial."""
    noise = rng.standard_normal((len(z), NUM_TRIALS, num_numbers))
    for j in range(1, num_numbers):
        kept = (1 - correlation**2) ** 0.5 * noise[..., j]
        noise[..., j] = correlation * noise[..., j - 1] + kept
    return z @ np.ones((1, NUM_TRIALS * num_numbers)) + noise.reshape(len(z), -1)


def regression(rng, num_numbers, correlation):
    z = rng.standard_normal((NUM_ROWS, 1))
    again = [outcomes(rng, z[:40], num_numbers, correlation) for _ in range(2)]
    x = outcomes(rng, z, num_numbers, correlation)
    return LocalRegression.fit(
        whole_space(1),
        z,
        x,
        noise=estimate_noise(*again, np.abs(x).max(0)),
        num_trials=NUM_TRIALS,
    )


@pytest.mark.parametrize("misfit", [np.inf, 0.0])  # trials have nothing in common; some
@pytest.mark.parametrize("correlation", [0.0, 0.9])
@pytest.mark.parametrize("num_numbers", [1, 30])
def test_a_further_trial_is_as_far_out_as_those_held_out(
    num_numbers, correlation, misfit, monkeypatch
):
    monkeypatch.setattr(surrogate, "MISFIT", misfit)
    known, new = [], []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        fit = regression(rng, num_numbers, correlation)
        z = rng.standard_normal((400, 1))
        error, widening = fit.whitened(z)  # less zero, which is no observation
        error -= fit.covariance.whiten(outcomes(rng, z, num_numbers, correlation))
        new.append(_squares(error, NUM_TRIALS) / widening[:, None])
        known.append(_held_out(fit, NUM_TRIALS))
    known, new = np.concatenate(known), np.concatenate(new)
    # By the same covariance in each seed, hence more than the error of their means.
    assert known.mean(0) == pytest.approx(
        new.mean(0), rel=0.2 if num_numbers == 1 else 0.05
    )
    assert known.std(0) == pytest.approx(new.std(0), rel=0.3)


@pytest.mark.parametrize("num_numbers", [1, 50])
def test_small_tail_probabilities_are_as_rare_as_they_say(num_numbers):
    rng = np.random.default_rng(0)
    p = np.concatenate(
        [
            _exceedance(
                rng.chisquare(num_numbers, 200),
                rng.chisquare(num_numbers, 20),
            )
            for _ in range(500)
        ]
    )
    for level in (3e-4, 1e-3, 0.01, 0.1, 0.5):
        most = binom.ppf(0.9999, len(p), level)
        assert (p <= level).sum() <= 1.5 * most  # the tail is a guess
    far = chi2.isf(1e-7, num_numbers)
    draws = rng.chisquare(num_numbers, 200)
    assert _exceedance(draws, np.array([far])) < 1e-3


@pytest.mark.parametrize("lost", [0, 30])
def test_many_correlated_numbers_of_the_right_simulator_are_not_unlike_it(lost):
    def simulator(theta, action):
        noise = torch.randn(len(theta), 150).cumsum(1) / 10
        return theta * action + noise

    prior = MultivariateNormal(torch.zeros(1), torch.eye(1))
    tails = []
    for seed in range(3):
        torch.manual_seed(seed)
        x = simulator(prior.sample((1,)), torch.ones(1, 1))
        x[:, torch.randperm(150)[:lost]] = torch.nan
        settings = RefinementOptions(num_histories=300, num_effective=25)
        belief = refine(
            simulator, prior, torch.ones(1, 1), x, settings=settings, seed=seed
        )
        tails.append(belief.diagnostics.tail_probability)
    assert min(tails) > 0.01

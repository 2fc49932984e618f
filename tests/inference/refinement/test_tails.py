"""Tail probabilities of the observations are those of further simulations."""

import numpy as np
import pytest
import torch
from scipy.stats import binom, chi2
from torch.distributions import MultivariateNormal

from sbi_active.inference import RefinementOptions, refine
from sbi_active.inference.refinement.checks import _exceedance


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

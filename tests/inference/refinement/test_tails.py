"""Tail probabilities of the observations are those of further simulations."""

import pytest
import torch
from torch.distributions import MultivariateNormal

from sbi_active.inference import RefinementOptions, refine


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

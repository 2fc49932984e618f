"""Surprises are uniform where the simulator is right, and small where it is not."""

import pytest
import torch
from scipy.stats import binom
from torch.distributions import MultivariateNormal

from sbi_active.campaign.score import score_outcome, simulate_from

PRIOR = MultivariateNormal(torch.zeros(1), torch.eye(1))
ACTION = torch.ones(1)


def noisy(num_numbers):
    def simulator(theta, action):
        return theta * action + 0.5 * torch.randn(len(theta), num_numbers)

    return simulator


def drops_out(theta, action):
    """Each of 40 numbers is there in four of five simulations."""
    x = noisy(40)(theta, action)
    return torch.where(torch.rand_like(x) < 0.2, torch.nan, x)


def falls_off(theta, action):
    """A walk that ends where it leaves the table: its last number is its largest."""
    x = torch.randn(len(theta), 12).cumsum(1) + theta * action
    is_over = ((x.abs() > 3).cumsum(1) - (x.abs() > 3).long()) > 0
    return torch.where(is_over, torch.nan, x)


def surprises(simulator, num=60, change=None, num_samples=200):
    found = []
    for seed in range(num):
        torch.manual_seed(1_000 + seed)
        x = simulator(PRIOR.sample((1,)), ACTION[None])[0]
        x = x if change is None else change(x)
        found.append(
            score_outcome(
                x,
                simulate_from(
                    PRIOR, simulator, ACTION, num_samples=num_samples, seed=seed
                ),
            )[0]
        )
    return torch.tensor(found)


def assert_valid(found):
    """No more are small than chance has it, at a level of 1 in 1,000 each."""
    for level in (0.01, 0.05, 0.2, 0.5):
        most = binom.ppf(0.999, len(found), level)
        assert int((found <= level).sum()) <= most, (level, found.sort().values)


@pytest.mark.parametrize("num_numbers", [1, 90])
def test_surprises_are_uniform_for_any_number_of_numbers(num_numbers):
    found = surprises(noisy(num_numbers))
    assert_valid(found)
    assert float(found.mean()) < 0.65  # not merely large


@pytest.mark.parametrize("simulator", [drops_out, falls_off])
def test_surprises_are_uniform_where_the_simulator_leaves_numbers_out(simulator):
    assert_valid(surprises(simulator))

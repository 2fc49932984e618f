"""Surprises are uniform where the simulator is right, and small where it is not."""

import math

import pytest
import torch
from scipy.stats import binom
from torch.distributions import MultivariateNormal

from sbi_active.campaign.score import score_outcome

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
                x, ACTION, simulator, PRIOR, num_samples=num_samples, seed=seed
            ).surprise
        )
    return torch.tensor(found)


def assert_valid(found):
    """No more are small than chance has it, at a level of 1 in 1,000 each."""
    for level in (0.01, 0.05, 0.2, 0.5):
        most = binom.ppf(0.999, len(found), level)
        assert int((found <= level).sum()) <= most, (level, found.sort().values)


def lose(numbers):
    def change(x):
        x = x.clone()
        x[numbers] = torch.nan
        return x

    return change


@pytest.mark.parametrize("num_numbers", [1, 90, 260])
def test_surprises_are_uniform_for_any_number_of_numbers(num_numbers):
    found = surprises(noisy(num_numbers))
    assert_valid(found)
    assert float(found.mean()) < 0.65  # not merely large


@pytest.mark.parametrize("simulator", [drops_out, falls_off])
def test_surprises_are_uniform_where_the_simulator_leaves_numbers_out(simulator):
    assert_valid(surprises(simulator))


@pytest.mark.parametrize("simulator", [noisy(150), drops_out])
def test_a_sensor_that_drops_out_is_no_surprise(simulator):
    assert_valid(surprises(simulator, change=lose([1, 4])))


def test_numbers_that_were_measured_are_compared_with_the_same_numbers():
    def simulator(theta, action):  # the first two numbers are far wider
        return torch.randn(len(theta), 10) * torch.tensor([1e3, 1e3, *[1.0] * 8])

    x = torch.zeros(10)
    x[:2], x[5] = torch.nan, 6.0
    kept = score_outcome(x, ACTION, simulator, PRIOR, num_samples=400, seed=0)
    assert kept.surprise < 0.02
    exact = 8 * 0.5 * math.log(2 * math.pi) + 18.0
    assert kept.log_score == pytest.approx(-exact, rel=0.15)


@pytest.mark.parametrize("num_numbers", [3, 300])
def test_an_outlier_is_surprising(num_numbers):
    def outlier(x):
        return x + 0.5 * 12 * torch.eye(num_numbers)[num_numbers // 2]

    found = surprises(noisy(num_numbers), num=20, change=outlier)
    assert int((found < 0.05).sum()) >= 15


def test_numbers_are_surprising_where_simulations_seldom_have_them():
    def ends(theta, action):
        x = noisy(10)(theta, action)
        is_over = torch.arange(10) >= torch.randint(4, 7, (len(x), 1))
        return torch.where(is_over, torch.nan, x)

    def score(x):
        return score_outcome(x, ACTION, ends, PRIOR, num_samples=400, seed=0)

    longer, shorter = torch.zeros(10), torch.zeros(10)
    shorter[3:] = torch.nan
    assert score(longer).surprise < 0.01
    assert score(shorter).surprise > 0.05  # what is absent tells nothing


def test_equal_outcomes_are_equally_surprising():
    def coin(theta, action):
        return (torch.rand(len(theta), 3) < torch.tensor([0.5, 0.1, 0.1])).float()

    x = torch.zeros(3)
    found = score_outcome(x, ACTION, coin, PRIOR, num_samples=999, seed=0)
    # Either side of the coin in all that is not rarer: .81 have no rarer number.
    assert found.surprise > 0.4


def test_the_log_score_of_many_numbers_is_near_that_of_the_predictive():
    q = 150
    covariance = 0.25 * torch.eye(q) + 1.0
    predictive = MultivariateNormal(torch.zeros(q), covariance)
    torch.manual_seed(0)
    x = predictive.sample()
    found = score_outcome(x, ACTION, noisy(q), PRIOR, num_samples=400, seed=0)
    assert found.log_score == pytest.approx(float(predictive.log_prob(x)), abs=10)

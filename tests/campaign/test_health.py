"""Surprises, log scores, and the two tests behind a campaign's health."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.integrate import quad
from scipy.stats import binom
from torch.distributions import MultivariateNormal, Normal

from sbi_active.campaign import CampaignOptions, Trial
from sbi_active.campaign.health import assess, log_e_value
from sbi_active.campaign.score import SHARES, Spread, score_outcome
from sbi_active.campaign.state import CampaignState, ModelVersion
from sbi_active.seeding import derive_seed, forked_generators
from sbi_active.simulation import simulate

PRIOR = MultivariateNormal(torch.zeros(1), torch.eye(1))
ACTION = torch.tensor([2.0])


def simulator(theta, action):
    return theta * action + 0.5 * torch.randn_like(theta)


def score(x, simulator=simulator, action=ACTION, num_samples=2_000, seed=0):
    """Return the surprise and the log score of an outcome."""
    with forked_generators(seed, "theta"):
        theta = PRIOR.sample((num_samples,))
    action = action.expand(num_samples, -1)
    rows = simulate(simulator, theta, action, seed=derive_seed(seed, "x"))
    return score_outcome(torch.as_tensor(x), rows.x)


def test_surprise_and_log_score_are_those_of_the_predictive():
    predictive = Normal(0.0, math.sqrt(4.25))  # 2 theta + noise
    for x in (0.5, -3.0, 5.0):
        surprise, log_score = score([x])
        tail = 2 * float(predictive.cdf(torch.tensor(-abs(x))))
        log_p = float(predictive.log_prob(torch.tensor(x)))
        # Binomial error of 2,000 simulations, that of their mean, one in the numerator.
        error = math.sqrt(tail * (1 - tail) / 2_000)
        error += 2 * math.exp(log_p) * math.sqrt(4.25 / 2_000)
        assert surprise == pytest.approx(tail, abs=4 * error + 1 / 2_000)
        assert log_score == pytest.approx(log_p, abs=0.2)
    assert score([60.0])[0] == pytest.approx(1 / 2_001)


def test_the_e_value_has_mean_one_and_is_continuous_at_one():
    mean, _ = quad(lambda p: math.exp(log_e_value(p)), 1e-12, 1, limit=400)
    assert mean == pytest.approx(1 - 1 / math.log(1e12), abs=0.01)
    assert log_e_value(1.0) == pytest.approx(math.log(0.5))
    for p in (0.9998, 0.99995):
        assert log_e_value(p) == pytest.approx(math.log(0.5 + (1 - p) / 6), abs=1e-5)


def state(surprises, misfits=None, **version):
    misfits = [None] * len(surprises) if misfits is None else misfits
    trials = [
        Trial(i, ACTION, torch.zeros(1), "ok", surprise=s, misfit=m, version=0)
        for i, (s, m) in enumerate(zip(surprises, misfits, strict=True))
    ]
    made = CampaignState("nsbi", 0, CampaignOptions(), trials, [*range(len(trials))])
    made.versions[-1] = replace(ModelVersion(), **version)
    return made


def test_health_from_surprises():
    assert assess(state([])) == "ok"
    assert assess(state([0.4, 0.8, 0.1])) == "ok"
    assert assess(state([0.4, 2e-3])) == "watch"
    assert assess(state([0.4, 5e-4, 5e-3])) == "alarm"
    # An alarm stays; another model starts anew.
    assert assess(state([0.4, 5e-4, 5e-3, *[0.9] * 20])) == "alarm"
    assert assess(state([0.4, 5e-4, 5e-3], number=1)) == "ok"


def test_a_belief_that_is_off_for_want_of_simulations_is_no_test():
    made = state([0.4, 5e-4, 5e-3])
    for error, expected in ((0.1, "alarm"), (0.3, "ok"), (math.inf, "ok")):
        made.change(1, belief_error=error)
        assert assess(made) == expected


def test_health_from_misfit():
    assert assess(state([0.5, 0.5], [0.5, 0.05])) == "ok"
    assert assess(state([0.5, 0.5], [0.5, 0.01])) == "watch"
    assert assess(state([0.5, 0.5], [0.5, 1e-3])) == "alarm"
    assert assess(state([0.5], [0.5], misfit=1e-3)) == "alarm"


@pytest.mark.parametrize("effect", [0.0, 1.5])
def test_alarms_are_rare_unless_predictions_fail(effect):
    """Predictions with standard normal errors, and with a shift in them."""
    alarms, num = 0, 400
    for i in range(num):
        gen = torch.Generator().manual_seed(derive_seed(i, "errors"))
        z = effect + torch.randn(12, generator=gen).double()
        p = (2 * Normal(0.0, 1.0).cdf(-z.abs())).clamp_min(1e-9).tolist()
        alarms += assess(state(p)) == "alarm"
    if effect:
        assert alarms > 0.5 * num
    else:  # the level, and 3 of its binomial errors
        level = 0.025
        assert alarms / num < level + 3 * math.sqrt(level * (1 - level) / num)


# Surprises are uniform where the simulator is right, and small where it is not


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


def surprises(simulator):
    found = []
    for seed in range(60):
        torch.manual_seed(1_000 + seed)
        x = simulator(PRIOR.sample((1,)), torch.ones(1, 1))[0]
        found.append(score(x, simulator, torch.ones(1), 200, seed)[0])
    return torch.tensor(found)


@pytest.mark.parametrize("simulator", [noisy(1), noisy(90), drops_out, falls_off])
def test_surprises_are_uniform_whatever_numbers_there_are(simulator):
    """No more are small than chance has it, at a level of 1 in 1,000 each."""
    found = surprises(simulator)
    for level in (0.01, 0.05, 0.2, 0.5):
        most = binom.ppf(0.999, len(found), level)
        assert int((found <= level).sum()) <= most, (level, found.sort().values)
    if simulator not in (drops_out, falls_off):
        assert float(found.mean()) < 0.65  # not merely large


def test_outcomes_without_a_measurement_are_counted():
    """The first of 1,000 simulations have none."""
    drawn = torch.arange(1_000.0)[:, None].clone()
    drawn[:100] = torch.nan
    none, middle = torch.tensor([torch.nan]), torch.tensor([549.5])
    assert score_outcome(none, drawn) == (101 / 1_001, math.log(100.5 / 1_002))
    # In the middle of the others: all are as far out, those without among them.
    assert score_outcome(middle, drawn)[0] == 1.0
    surprise, log_score = score_outcome(torch.tensor([1e6]), drawn)
    assert surprise == 101 / 1_001  # those without a measurement are as rare
    assert log_score < -1e3
    drawn[:500] = torch.nan
    assert score_outcome(none, drawn[1:])[0] == 1.0  # and here as common
    drawn[:600] = torch.nan
    assert score_outcome(middle, drawn)[0] <= 401 / 1_001  # and here the more common
    drawn[:] = torch.nan
    assert score_outcome(middle, drawn) == (1 / 1_001, -math.inf)
    drawn[:] = 0.0
    assert score_outcome(none, drawn)[1] == math.log(0.5 / 1_001)


def test_only_measured_numbers_are_compared():
    gen = torch.Generator().manual_seed(0)
    drawn = torch.randn(500, 3, generator=gen)
    whole, part = torch.tensor([0.1, 0.2, 50.0]), torch.tensor([0.1, 0.2, torch.nan])
    assert score_outcome(whole, drawn)[0] == 1 / 501
    assert score_outcome(part, drawn) == score_outcome(part[:2], drawn[:, :2])
    # Where the simulator leaves that number out as well, that may be the cause.
    drawn[:250, 2] = torch.nan
    far = torch.tensor([4.0, 0.2, torch.nan])
    alone = score_outcome(far[:2], drawn[:, :2])[0]
    assert alone <= score_outcome(far, drawn)[0] < 0.05
    drawn[:, 2] = torch.nan
    assert score_outcome(whole, drawn)[1] == -math.inf  # a number that none has
    assert score_outcome(whole, drawn)[0] <= 2 / 501


@pytest.mark.parametrize(("num", "num_numbers"), [(400, 12), (60, 150)])
def test_the_log_score_of_many_numbers_is_a_gaussian_s(num, num_numbers):
    """Its covariance is shrunk to the diagonal; here it is dense, and no product."""
    gen = torch.Generator().manual_seed(1)
    mix = torch.randn(num_numbers, num_numbers, generator=gen).double()
    drawn = torch.randn(num, num_numbers, generator=gen).double() @ mix
    x = torch.randn(num_numbers, generator=gen).double() @ mix
    share = Spread.of(drawn).share
    covariance = torch.cov(drawn.T, correction=0)
    diagonal = covariance.diagonal() * (1 + 1e-10)
    covariance = (1 - share) * covariance + share * diagonal.diag()
    exact = MultivariateNormal(drawn.mean(0), covariance).log_prob(x)
    known = math.log((num + 0.5) / (num + 1))
    assert score_outcome(x, drawn)[1] == pytest.approx(float(exact) + known, rel=1e-6)
    # Neither order nor units change the surprise.
    surprise = score_outcome(x, drawn)[0]
    units = torch.logspace(-6, 6, num_numbers).double()
    assert score_outcome(units * x, units * drawn.flip(0))[0] == surprise


@pytest.mark.parametrize("num_numbers", [2, 30])
def test_a_channel_in_small_units_counts(num_numbers):
    """Radians beside pascals: forty deviations had a tail probability of .52."""
    gen = torch.Generator().manual_seed(4)
    drawn = torch.randn(100, num_numbers, generator=gen)
    drawn[:, 0] *= 1e-8
    x = torch.zeros(num_numbers)
    assert score_outcome(x, drawn)[0] > 0.9
    x[0] = 4e-7
    assert score_outcome(x, drawn)[0] == 1 / 101


@pytest.mark.parametrize(("num", "num_numbers"), [(30, 5), (4, 3), (12, 20)])
def test_the_share_of_the_diagonal_is_the_best_without_each_row(num, num_numbers):
    gen = torch.Generator().manual_seed(2)
    mix = torch.randn(num_numbers, num_numbers, generator=gen).double()
    z = torch.randn(num, num_numbers, generator=gen).double() @ mix
    z = (z - z.mean(0)) / z.std(0, correction=0)
    losses, unit = [], torch.eye(num_numbers).double()
    for share in SHARES:
        loss = 0.0
        for i in range(num):
            rest = z[torch.arange(num) != i]
            c = (1 - share) * rest.T @ rest / (num - 1) + share * unit
            loss += float(c.logdet() + z[i] @ torch.linalg.solve(c, z[i]))
        losses.append(loss)
    best = SHARES[int(np.argmin(losses))]
    assert Spread.of(z).share == pytest.approx(float(best), rel=1e-3)


def test_two_modes_have_more_density_than_a_gaussian_gives_them():
    gen = torch.Generator().manual_seed(3)
    side = torch.where(torch.rand(4_000, 1, generator=gen) < 0.5, -3.0, 3.0)
    drawn = side + 0.3 * torch.randn(4_000, 1, generator=gen)
    mode = torch.tensor([3.0])
    gaussian, own = (float(Normal(*p).log_prob(mode)) for p in ((0, 3.01), (3, 0.3)))
    assert gaussian + 0.5 < score_outcome(mode, drawn)[1] < own - math.log(2)

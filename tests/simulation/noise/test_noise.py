import math

import numpy as np
import pytest
import torch
from scipy import stats

from sbi_active import AutocorrelatedNoise, GaussianNoise, StudentTNoise, estimate_noise
from sbi_active.seeding import row_seeds

SD = torch.tensor([0.5, 2.0]).double()
TIMES = torch.tensor([0.0, 0.1, 0.5, 0.6, 2.0]).double()
NUM = 20_000

NOISES = {
    "gaussian": GaussianNoise(1.5),
    "gaussian by channel": GaussianNoise(SD),
    "autocorrelated": AutocorrelatedNoise(1.5, 0.7),
    "autocorrelated by channel": AutocorrelatedNoise(SD, 0.7),
    "student": StudentTNoise(1.5, 5.0),
    "student by channel": StudentTNoise(SD, 5.0),
}


@pytest.fixture(params=NOISES.values(), ids=NOISES.keys())
def noise(request):
    return request.param.at(TIMES)


def covariance(times, tau, sd):
    times = np.asarray(times)
    return sd**2 * np.exp(-np.abs(times[:, None] - times) / tau)


def scipy_log_prob(noise, x):
    """Log density of residuals (n, 5, 2), independent of the library."""
    sd, shared = noise.sd.expand(2).numpy(), noise.parameters[-1].item()
    total = np.zeros(len(x))
    for c in range(2):
        for i, column in enumerate(x[..., c].numpy()):
            seen = ~np.isnan(column)
            if not seen.any():
                continue
            if isinstance(noise, AutocorrelatedNoise):
                cov = covariance(TIMES, shared, sd[c])[np.ix_(seen, seen)]
                law = stats.multivariate_normal(np.zeros(seen.sum()), cov)
                total[i] += law.logpdf(column[seen])
            elif isinstance(noise, StudentTNoise):
                scale = sd[c] * np.sqrt((shared - 2) / shared)
                total[i] += stats.t(shared, 0, scale).logpdf(column[seen]).sum()
            else:
                total[i] += stats.norm(0, sd[c]).logpdf(column[seen]).sum()
    return total


def test_log_density_is_that_of_scipy_also_where_masked(noise):
    x = 2 * torch.randn(40, 5, 2).double()
    x[torch.rand(40, 5, 2) < 0.3] = torch.nan
    x[0] = torch.nan
    mean = torch.full((1, 5, 2), 0.3).double()
    log_prob = noise.log_prob(x, mean)
    assert log_prob.dtype == torch.float64
    assert log_prob.shape == (40,)
    assert log_prob[0] == 0
    assert log_prob.numpy() == pytest.approx(scipy_log_prob(noise, x - mean))


def test_samples_have_the_declared_moments(noise):
    x = noise.sample(torch.ones(NUM, 5, 2), row_seeds(0, NUM)).double() - 1
    sd = noise.sd.expand(2)
    # Var(s^2) = (kurtosis - 1) sd^4 / n; kurtosis is 3, of t with 5 df it is 9
    kurtosis = 9 if isinstance(noise, StudentTNoise) else 3
    error = 4 * ((kurtosis - 1) / NUM) ** 0.5
    assert ((x.var(0) / sd**2 - 1).abs() < error).all()
    tau = 0.7 if isinstance(noise, AutocorrelatedNoise) else 1e-9
    expected = torch.from_numpy(covariance(TIMES, tau, 1.0)).float()
    for c in range(2):
        correlation = torch.corrcoef(x[..., c].T).float()
        assert (correlation - expected).abs().max() < 4 * 3 / NUM**0.5


def test_a_row_depends_on_its_seed_alone(noise):
    seeds, mean = row_seeds(3, 8), torch.randn(8, 5, 2)
    x = noise.sample(mean, seeds)
    order = torch.tensor([5, 0, 3])
    assert torch.equal(noise.sample(mean[order], seeds[order]), x[order])
    assert not torch.equal(noise.sample(mean, seeds + 1), x)
    torch.manual_seed(1)
    first = noise.sample(mean)
    torch.manual_seed(1)
    assert torch.equal(noise.sample(mean), first)


def test_sizes_that_are_unknown_by_channel_are_summed_channel_by_channel():
    bounds = [(0.1, 1.0), (20.0, 400.0)]
    sizes = {"correlation_time": (0.05, 2.0), "num_sds": 7, "num_times": 3}
    noise = AutocorrelatedNoise.unknown(sd=bounds, **sizes)
    assert noise.parameter_names == ("sd_1", "sd_2", "correlation_time")
    gen = torch.Generator().manual_seed(0)
    x = torch.randn(2, 5, 2, generator=gen).double() * torch.tensor([0.4, 90.0])
    x[1, 2, 1] = torch.nan
    nodes = [
        low * (high / low) ** ((np.arange(num) + 0.5) / num)
        for (low, high), num in zip([*bounds, (0.05, 2.0)], (7, 7, 3), strict=True)
    ]
    for row in x:
        terms = []
        for tau in nodes[2]:
            each = []
            for c in range(2):
                y = row[:, c].numpy()
                seen = ~np.isnan(y)
                zero, law = np.zeros(seen.sum()), stats.multivariate_normal
                covs = [covariance(TIMES[seen], tau, sd) for sd in nodes[c]]
                log_p = [law(zero, cov).logpdf(y[seen]) for cov in covs]
                each.append(np.logaddexp.reduce(log_p))
            terms.append(sum(each) - 2 * np.log(7) - np.log(3))
        expected = np.logaddexp.reduce(terms)
        got = noise.at(TIMES).log_prob(row[None], torch.zeros(5, 2))
        assert got.item() == pytest.approx(expected, rel=1e-9)
    draws = noise.posterior.sample((200,))
    for column, (low, high) in zip(draws.T, bounds, strict=False):
        assert low <= column.min() < 2 * low < high / 2 < column.max() <= high


# Noise that is estimated from repeated measurements


SETS = 150


def binomial_error(level, num):
    return 3 * math.sqrt(level * (1 - level) / num)


def coverage(inside):
    return np.mean(inside), binomial_error(0.9, len(inside))


@pytest.mark.parametrize("num_repeats", [3, 10])
def test_posterior_over_sd_covers(num_repeats):
    truth = torch.tensor([0.2, 3.0]).double()
    center = torch.tensor([1.0, -4.0]).double()
    inside, plugged = [], []
    for seed in range(SETS):
        mean = center.expand(num_repeats, 2)
        x = GaussianNoise(truth).sample(mean, row_seeds(seed, num_repeats))
        noise = estimate_noise(x)
        level = torch.tensor([[0.05, 0.05], [0.95, 0.95]]).double()
        low, high = noise.posterior.quantile(level)
        inside.append(bool((low[0] < truth[0]) & (truth[0] < high[0])))
        # An interval of 90 % for the next measurement, the estimate plugged in:
        # too narrow, which shows that this test can fail.
        new = GaussianNoise(truth).sample(center[None], row_seeds(seed + SETS, 1))
        plugged.append(bool(((new - x.mean(0)) / noise.sd).abs()[0, 0] < 1.645))
    share, error = coverage(inside)
    assert abs(share - 0.9) < error
    assert num_repeats > 3 or coverage(plugged)[0] < 0.9 - error


def test_marginal_of_gaussian_noise_is_a_student_t():
    x = torch.tensor([[1.0], [2.0], [4.0], [2.2]]).double()
    noise = estimate_noise(x)
    row = torch.tensor([[2.0]]).double()
    scale = x.std(0).item()
    expected = stats.t(3, 0, scale).logpdf(2.0)
    assert noise.log_prob(row, 0 * row).item() == pytest.approx(expected)
    drawn = noise.sample(torch.zeros(20_000, 1).double(), row_seeds(0, 20_000))
    law = stats.t(3, 0, scale)
    assert stats.kstest(drawn[:, 0].numpy(), law.cdf).pvalue > 1e-3
    # numbers that share one sd are dependent: a multivariate t
    pooled = estimate_noise(torch.randn(5, 4), pooled=True)
    assert pooled.parameter_names == ("sd",)
    e = torch.randn(6, 4).double()
    e[2, 1] = torch.nan
    joint = pooled.log_prob(e, torch.zeros(6, 4))
    sd = pooled.sd.item()
    for row, value in zip(e, joint, strict=True):
        seen = row[~row.isnan()].numpy()
        law = stats.multivariate_t(np.zeros(len(seen)), sd**2 * np.eye(len(seen)), 16)
        assert value.item() == pytest.approx(law.logpdf(seen))


def test_autocorrelated_noise_recovers_rho():
    rho, step, sets = 0.95, 0.02, 40
    tau = -step / math.log(rho)
    times = step * torch.arange(50).double()
    truth = AutocorrelatedNoise(2.0, tau).at(times)
    level = torch.tensor([[0.05, 0.05], [0.5, 0.5], [0.95, 0.95]]).double()
    inside, medians = [], []
    for seed in range(sets):
        x = truth.sample(torch.zeros(5, 50).double(), row_seeds(seed, 5))
        noise = estimate_noise(x + times.sin(), kind="autocorrelated", times=times)
        low, middle, high = torch.exp(-step / noise.posterior.quantile(level)[:, 1])
        inside.append(bool((low < rho) & (rho < high)))
        medians.append(middle.item())
    share, error = coverage(inside)
    assert abs(share - 0.9) < error
    spread = np.std(medians)
    assert abs(np.mean(medians) - rho) < 3 * spread / math.sqrt(sets) + 0.1 * spread
    assert spread < 0.1


def test_marginal_agrees_with_draws_of_the_posterior():
    truth = AutocorrelatedNoise(1.0, 3.0)
    x = truth.sample(torch.zeros(4, 12, 2).double(), row_seeds(1, 4))
    x[1, 3, 0] = torch.nan
    noise = estimate_noise(x, kind="autocorrelated")
    assert len(noise.parameters) == noise.posterior.event_shape[0] == 3
    e = truth.sample(torch.zeros(3, 12, 2).double(), row_seeds(9, 3))
    e[0, 4:6, 1] = torch.nan
    marginal = noise.log_prob(e, torch.zeros(1, 12, 2))
    draws = noise.posterior.sample((2_000,))
    laws = [AutocorrelatedNoise(p[:2], p[2]) for p in draws]
    each = torch.stack([law.log_prob(e, torch.zeros(1, 12, 2)) for law in laws])
    for terms, value in zip(each.T, marginal, strict=True):
        weight = (terms - terms.max()).exp()
        error = (weight.std() / weight.mean() / len(draws) ** 0.5).item()
        average = terms.logsumexp(0).item() - math.log(len(draws))
        # .03 nats for the width of the grid's cells
        assert abs(value.item() - average) < 4 * error + 0.03


def test_a_trajectory_of_one_channel_has_a_marginal():
    x = AutocorrelatedNoise(1.0, 3.0).sample(torch.zeros(4, 12), row_seeds(1, 4))
    noise = estimate_noise(x, kind="autocorrelated")
    own = noise.log_prob(x, torch.zeros(1, 12))
    assert torch.allclose(own, noise.log_prob(x[..., None], torch.zeros(1, 12, 1)))

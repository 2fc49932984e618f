import numpy as np
import pytest
import torch
from scipy import stats

from sbi_active import AutocorrelatedNoise, GaussianNoise, StudentTNoise
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
    noise = AutocorrelatedNoise.unknown(
        sd=bounds, correlation_time=(0.05, 2.0), num_sds=7, num_times=3
    )
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
                laws = [
                    stats.multivariate_normal(
                        np.zeros(seen.sum()), covariance(TIMES[seen], tau, sd)
                    )
                    for sd in nodes[c]
                ]
                each.append(np.logaddexp.reduce([law.logpdf(y[seen]) for law in laws]))
            terms.append(sum(each) - 2 * np.log(7) - np.log(3))
        expected = np.logaddexp.reduce(terms)
        got = noise.at(TIMES).log_prob(row[None], torch.zeros(5, 2))
        assert got.item() == pytest.approx(expected, rel=1e-9)
    draws = noise.posterior.sample((200,))
    for column, (low, high) in zip(draws.T, bounds, strict=False):
        assert low <= column.min() < 2 * low < high / 2 < column.max() <= high

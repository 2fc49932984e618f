import math

import numpy as np
import pytest
import torch
from scipy import stats

from sbi_active import AutocorrelatedNoise, GaussianNoise, estimate_noise
from sbi_active.seeding import row_seeds

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
        law = stats.multivariate_t(
            np.zeros(len(seen)), sd**2 * np.eye(len(seen)), df=16
        )
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

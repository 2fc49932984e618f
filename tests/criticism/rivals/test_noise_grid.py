"""What a declared noise model gives, against densities summed by hand."""

import numpy as np
import pytest
import torch
from scipy import stats
from scipy.stats import multivariate_normal

from sbi_active import AutocorrelatedNoise, GaussianNoise, StudentTNoise, estimate_noise
from sbi_active.criticism import Trials
from sbi_active.criticism.data.measurements import Measurements
from sbi_active.criticism.rivals.noise_grid import (
    INDEPENDENT,
    NUM_DRAWS,
    declared_noise,
    measurement_sds,
)

TIMES = np.array([0.0, 0.1, 0.3, 0.6, 1.0])


def test_noise_without_size_is_refused():
    m = Measurements.of(Trials([0.0, 1.0], [0.0, 1.0]))
    with pytest.raises(ValueError, match="expected measurement noise with a standard"):
        declared_noise(GaussianNoise(0.0), m)


def trajectories():
    x = torch.tensor([[0.1, 0.4, torch.nan, 0.2, -0.3], [1.0, 0.9, 0.5, 0.4, 0.2]])
    return Measurements.of(Trials([0.0, 1.0], x, sample_times=TIMES))


def correlated(m, sd, tau):
    """Return the exact log density of the measurements as correlated noise."""
    log_p = 0.0
    for trial in np.unique(m.trial):
        at = m.trial == trial
        gap = np.abs(m.time[at][:, None] - m.time[at])
        cov = sd**2 * (np.exp(-gap / tau) if tau > 0 else np.eye(at.sum()))
        log_p += multivariate_normal(np.zeros(at.sum()), cov).logpdf(m.x[at])
    return log_p


def test_an_open_correlation_is_none_or_of_any_time():
    m = trajectories()
    # Half a sample step to twice the recording, log-uniform.
    times = np.geomspace(0.5 * m.step, 2 * 1.0, 14)
    each = [correlated(m, 0.7, tau) for tau in (0.0, *times)]
    weights = [INDEPENDENT, *14 * [(1 - INDEPENDENT) / 14]]
    expected = np.logaddexp.reduce(np.array(each) + np.log(weights))
    got = declared_noise(GaussianNoise(0.7), m).log_likelihood(m.x[None])[0]
    assert got == pytest.approx(expected, rel=1e-6)


def test_each_channel_has_its_own_deviation():
    x = torch.tensor([[1.0, torch.nan, 3.0], [0.5, -20.0, 10.0]])
    m = Measurements.of(Trials([0.0, 1.0], x))
    sd = torch.tensor([1.0, 10.0, 5.0])
    got = declared_noise(GaussianNoise(sd), m).log_likelihood(m.x[None])[0]
    assert got == pytest.approx(stats.norm(0, sd).logpdf(x)[x.isfinite()].sum())
    with pytest.raises(ValueError, match="for each of 3 channels; got 2"):
        declared_noise(GaussianNoise(sd[:2]), m)


def test_t_noise_has_the_deviation_that_was_declared():
    m = Measurements.of(Trials([0.0, 1.0], [0.3, -4.0]))
    got = declared_noise(StudentTNoise(0.5, df=3.0), m).log_likelihood(m.x[None])[0]
    law = stats.t(3, scale=0.5 / np.sqrt(3))
    assert got == pytest.approx(law.logpdf([0.3, -4.0]).sum())


def test_unknown_size_and_correlation_are_summed_on_their_grid():
    m = trajectories()
    noise = AutocorrelatedNoise.unknown(
        sd=(0.1, 3.0), correlation_time=(0.05, 2.0), num_sds=9, num_times=5
    )
    grid = declared_noise(noise, m)
    assert (len(grid.cells), len(grid.scales)) == (5, 9)
    sds, times = (
        low * (high / low) ** ((np.arange(num) + 0.5) / num)
        for low, high, num in ((0.1, 3.0, 9), (0.05, 2.0, 5))
    )
    each = [correlated(m, sd, tau) for sd in sds for tau in times]
    expected = np.logaddexp.reduce(each) - np.log(len(each))
    assert grid.log_likelihood(m.x[None])[0] == pytest.approx(expected, rel=1e-6)


def test_errors_that_are_known_by_channel_have_their_units_along_a_trajectory():
    gen = torch.Generator().manual_seed(0)
    unit = torch.tensor([1.0, 500.0]).double()
    x = torch.randn(2, 5, 2, generator=gen).double() * unit
    m = Measurements.of(Trials([0.0, 1.0], x, sample_times=TIMES))
    noise = AutocorrelatedNoise(0.7 * unit, 0.4, measurement_sd=0.1 * unit)
    expected = 0.0
    cov = 0.49 * np.exp(-np.abs(TIMES[:, None] - TIMES) / 0.4)
    for series in (x / unit).permute(0, 2, 1).reshape(4, 5):
        expected += multivariate_normal(np.zeros(5), cov).logpdf(series)
    expected -= 10 * np.log(unit).sum()
    got = declared_noise(noise, m).log_likelihood(m.x[None])[0]
    assert got == pytest.approx(float(expected), rel=1e-9)
    np.testing.assert_allclose(measurement_sds(noise, m), 0.1 * unit.numpy()[m.channel])
    assert measurement_sds(GaussianNoise(1.0), m) is None
    assert measurement_sds(AutocorrelatedNoise(1.0, 0.4, measurement_sd=0.2), m) == 0.2


def test_a_posterior_over_the_size_is_summed_out_by_draws():
    repeats = 0.3 * torch.randn(60, 1, generator=torch.Generator().manual_seed(0))
    m = Measurements.of(Trials([0.0, 1.0, 2.0], [0.3, -0.4, 0.5]))
    grid = declared_noise(estimate_noise(repeats), m)
    assert len(grid.cells) == NUM_DRAWS
    # Numbers that share one unknown size are a multivariate t together.
    scale = float(repeats.std()) ** 2 * np.eye(3)
    expected = stats.multivariate_t(np.zeros(3), scale, df=59).logpdf(m.x)
    # A size known to 9 % has a density known to .16 nats a draw, here.
    assert grid.log_likelihood(m.x[None])[0] == pytest.approx(expected, abs=0.15)


def test_a_posterior_over_one_size_may_be_of_single_numbers():
    """Its draws have no axis of parameters."""
    m = Measurements.of(Trials([0.0, 1.0, 2.0], [0.3, -0.4, 0.5]))
    size = torch.distributions.LogNormal(np.log(0.3), 0.1)
    grid = declared_noise(GaussianNoise(0.3, posterior=size), m)
    assert len(grid.cells) == NUM_DRAWS
    assert all(cell.sd.shape == (3,) for cell in grid.cells)

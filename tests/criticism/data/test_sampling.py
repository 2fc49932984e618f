"""The rate from which samples say nothing of their own, from known processes."""

import numpy as np
import pytest
import torch

from sbi_active.criticism import Trials
from sbi_active.criticism.data.measurements import Measurements
from sbi_active.criticism.linear.screening import Sampling, suggested_sampling, thinned
from tests.effects import autocorrelated

STEP = 0.02


def trials_of(x, step=STEP):
    times = step * torch.arange(1, x.shape[1] + 1).double()
    return Trials(torch.arange(len(x)).double(), x, sample_times=times)


def suggested(trials, x, times=None):
    m = Measurements.of(trials, times)
    return suggested_sampling(m, np.asarray(x).reshape(-1)[m.position])


def smooth(num, length, width, rng):
    """Return a process that is correlated as a Gaussian of a width in samples."""
    at = np.arange(-4 * width, 4 * width + 1)
    kernel = np.exp(-((at / width) ** 2))
    kernel /= np.sqrt((kernel**2).sum())
    white = rng.normal(size=(num, length + len(at) - 1))
    return np.stack([np.convolve(row, kernel, "valid") for row in white])


@pytest.mark.parametrize("rho", [0.0, 0.5, 0.95])
def test_errors_as_assumed_are_kept_all(rho):
    x = autocorrelated(np.random.default_rng(0).normal(size=(8, 300)), rho)
    found = suggested(trials_of(x), x)
    assert found.every == 1
    assert abs(found.before) < 0.1
    assert found.suggested_step == pytest.approx(STEP)


@pytest.mark.parametrize("width", [5, 10])
@pytest.mark.parametrize("seed", [0, 1])
def test_smooth_errors_are_thinned_to_about_their_width(width, seed):
    x = smooth(8, 500, width, np.random.default_rng(seed))
    found = suggested(trials_of(x), x)
    assert 1.0 * width <= found.every <= 2.5 * width
    assert found.before > 0.9
    assert found.after <= 0.2
    # Their correlation is exp(-d^2 / (2 width^2)): as far apart, less than .61.
    other = suggested(trials_of(x, step=1.0), x)
    assert other.every == found.every
    assert other.suggested_step == pytest.approx(found.every)


def test_the_sensor_s_error_on_top_counts_by_its_size():
    rng = np.random.default_rng(0)
    x = 0.3 * smooth(8, 300, 6, rng) + rng.normal(size=(8, 300))
    assert suggested(trials_of(x), x).every == 1
    x = smooth(8, 2_000, 40, rng) + 0.05 * rng.normal(size=(8, 2_000))
    # From sample to sample the smooth one moves by .025, half of the sensor's error.
    assert 40 <= suggested(trials_of(x), x).every <= 100


def test_at_least_eight_samples_are_left():
    x = np.sin(np.arange(40) / 30 + np.arange(6)[:, None])
    assert suggested(trials_of(x), x).every <= 5
    short = x[:, :7]
    assert suggested(trials_of(short), short).every == 1


def test_gaps_several_channels_and_ragged_trials():
    rng = np.random.default_rng(2)
    x = np.stack([smooth(6, 400, 5, rng), 1e3 * smooth(6, 400, 5, rng)], -1)
    x[:, 350:] = np.nan
    x[2, 100:120, 0] = np.nan
    times = STEP * (1 + np.arange(400)) + 0.002 * rng.random((6, 400))
    trials = Trials(torch.arange(6.0), x, sample_times=times)
    assert 5 <= suggested(trials, x).every <= 13
    by_model = Trials(torch.arange(6.0), x)
    assert suggested(by_model, x, times).every <= 13


def test_channels_of_other_rates_and_short_trials_keep_their_own():
    x = torch.full((2, 12, 2), torch.nan)
    x[0, :, 0] = 1.0
    x[0, 1::4, 1] = 2.0  # a slow sensor, between the other's samples
    x[1, :2] = 3.0  # a trial that ended early
    trials = Trials([1.0, 2.0], x, sample_times=torch.arange(12.0))
    few = thinned(trials, Sampling(step=1.0, every=3, before=0.9, after=0.1)).mask
    assert few[0, :, 0].nonzero()[:, 0].tolist() == [2, 5, 8, 11]
    assert few[0, :, 1].nonzero()[:, 0].tolist() == [5, 9]
    assert few[1].nonzero()[:, 0].tolist() == [1, 1]


def test_a_slow_channel_beside_a_fast_one_does_not_hide_it():
    rng = np.random.default_rng(0)
    x = np.full((6, 600, 2), np.nan)
    x[:, :, 0] = smooth(6, 600, 10, rng)
    x[:, 3::50, 1] = rng.normal(size=(6, 12))
    assert 8 <= suggested(trials_of(x), x).every <= 25
    x[:, 3::5, 1] = smooth(6, 600, 10, rng)[:, 3::5]
    assert 4 <= suggested(trials_of(x), x).every <= 25

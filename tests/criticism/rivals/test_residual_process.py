"""The residual process against Gaussians of the stated covariance."""

import numpy as np
import pytest
import torch
from scipy.stats import multivariate_normal

from sbi_active import GaussianNoise
from sbi_active.criticism import Trials
from sbi_active.criticism.data.measurements import Measurements
from sbi_active.criticism.rivals.error_models import NoiseCell, NoiseGrid
from sbi_active.criticism.rivals.noise_grid import declared_noise
from sbi_active.criticism.rivals.residual_process import TIME_LENGTH, ResidualProcess

ACTION = torch.linspace(-2, 2, 8)[:, None]
X = torch.tensor([0.3, 1.4, -0.2, 0.8, 2.2, 1.1, 3.5, 2.9])[:, None]
XI = ACTION[:, 0].double().numpy()
AMPLITUDES = np.geomspace(1, 20, 10)


def test_the_residual_process_is_a_gaussian_of_the_stated_covariance():
    trials = Trials(ACTION, X)
    m = Measurements.of(trials)
    noise = declared_noise(GaussianNoise(0.5), m)
    action = ACTION.double().numpy() / 4
    process = ResidualProcess(noise, m, action=action, largest=20.0, lengths=(0.3,))
    r = X[:, 0].double().numpy()
    kernel = np.exp(-0.5 * ((action - action.T) / 0.3) ** 2)
    each = [
        multivariate_normal(np.zeros(8), 0.25 * (a**2 * kernel + np.eye(8))).logpdf(r)
        for a in np.geomspace(1, 20, 10)
    ]
    expected = np.logaddexp.reduce(each) - np.log(10)
    # Directions below 1e-5 of the variance are left out.
    assert process.log_likelihood(r[None])[0] == pytest.approx(expected, abs=1e-2)


def test_one_process_follows_the_order_of_the_trials():
    m = Measurements.of(Trials(ACTION, X))
    noise = declared_noise(GaussianNoise(0.5), m)
    order = np.arange(8) / 7
    action = np.random.default_rng(0).permutation(ACTION.double().numpy() / 4)
    r = X[:, 0].double().numpy()
    parts = [
        ResidualProcess(noise, m, action=place, largest=20.0, lengths=(0.3,))
        for place in (action, order[:, None])
    ]
    both = ResidualProcess(
        noise, m, action=action, order=order, largest=20.0, lengths=(0.3,)
    )
    each = [process.log_likelihood(r[None])[0] for process in parts]
    expected = np.logaddexp(*each) - np.log(2)
    assert both.log_likelihood(r[None])[0] == pytest.approx(expected)
    # A slow drift is carried on for a while.
    drift = 4 * np.sin(2 * order)
    later = np.concatenate([order, order[-1:] + 0.05])
    there = np.concatenate([action, action[:1]])
    one = Measurements.of(Trials(ACTION[:1], X[:1]))
    mean, _ = both.condition(drift[None], one, there, order=later)
    assert mean[0, 0] == pytest.approx(4 * np.sin(2 * later[-1]), abs=0.5)


def test_the_residual_process_may_grow_with_the_prediction():
    m = Measurements.of(Trials(ACTION, X))
    noise = declared_noise(GaussianNoise(0.5), m)
    action = ACTION.double().numpy() / 4
    spread = np.exp(3 * XI)
    process = ResidualProcess(
        noise, m, action=action, largest=20.0, lengths=(0.3,), spread=spread
    )
    r = X[:, 0].double().numpy()
    kernel = np.exp(-0.5 * ((action - action.T) / 0.3) ** 2)
    relative = spread * np.median(0.5 / spread)
    each = [
        multivariate_normal(
            np.zeros(8), a**2 * kernel * np.outer(b, b) + 0.25 * np.eye(8)
        ).logpdf(r)
        for a in np.geomspace(1, 20, 10)
        for b in (np.full(8, 0.5), relative)
    ]
    expected = np.logaddexp.reduce(each) - np.log(20)
    # Directions below 1e-5 of the variance are left out.
    assert process.log_likelihood(r[None])[0] == pytest.approx(expected, abs=1e-2)


def covariance(points, others, length):
    """Return the kernel of two sets of places, shape (n, m)."""
    return np.exp(-0.5 * ((points[:, None] - others) / length) ** 2)


def test_the_best_process_is_interpolated_with_its_own_uncertainty():
    m = Measurements.of(Trials(ACTION, X))
    # Half of the deviation and a factor of two.
    noise = NoiseGrid([NoiseCell.of(m, sd=np.full(8, 0.25))], scales=np.array([2.0]))
    place = ACTION.double().numpy() / 4
    process = ResidualProcess(noise, m, action=place, largest=20.0, lengths=(0.3,))
    r = X[:, 0].double().numpy()
    kernel = covariance(place[:, 0], place[:, 0], 0.3)

    def total(a):
        return 0.25 * (a**2 * kernel + np.eye(8))

    likeliest = max(
        process.amplitudes,
        key=lambda a: multivariate_normal(np.zeros(8), total(a)).logpdf(r),
    )
    there = np.array([-0.45, 0.1, 0.3])
    new = Measurements.of(Trials(4 * there[:, None], np.zeros((3, 1))))
    everywhere = np.concatenate([place, there[:, None]])
    mean, sd = process.condition(np.stack([r, 2 * r]), new, everywhere)
    # The amplitude is that of the mean residual, 1.5 r.
    best = max(
        process.amplitudes,
        key=lambda a: multivariate_normal(np.zeros(8), total(a)).logpdf(1.5 * r),
    )
    assert AMPLITUDES[0] < likeliest <= best
    across = 0.25 * best**2 * covariance(there, place[:, 0], 0.3)
    weight = across @ np.linalg.inv(total(best))
    np.testing.assert_allclose(mean, np.stack([weight @ r, 2 * weight @ r]), rtol=1e-6)
    variance = 0.25 * best**2 - np.einsum("mi,mi->m", weight, across)
    np.testing.assert_allclose(sd**2, variance, rtol=1e-6)


def test_trajectories_are_smooth_in_action_and_time():
    times = np.linspace(0, 1, 5)
    x = np.random.default_rng(0).normal(size=(3, 5))
    m = Measurements.of(Trials([0.0, 1.0, 2.0], x, sample_times=times))
    noise = NoiseGrid([NoiseCell.of(m, sd=np.full(15, 0.3), correlation_time=0.2)])
    place = np.array([[0.0], [0.2], [1.0]])
    process = ResidualProcess(noise, m, action=place, largest=20.0, lengths=(0.3,))
    apart = (place[m.trial] - place[m.trial].T) / 0.3
    later = m.time[:, None] - m.time
    same = m.trial[:, None] == m.trial
    smooth = np.exp(-0.5 * apart**2 - 0.5 * (later / TIME_LENGTH) ** 2)
    rough = np.where(same, np.exp(-np.abs(later) / 0.2), 0.0)
    each = [
        multivariate_normal(np.zeros(15), 0.09 * (a**2 * smooth + rough)).logpdf(m.x)
        for a in AMPLITUDES
    ]
    expected = np.logaddexp.reduce(each) - np.log(10)
    assert process.log_likelihood(m.x[None])[0] == pytest.approx(expected, abs=2e-2)

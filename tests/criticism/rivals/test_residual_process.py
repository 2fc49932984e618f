"""The residual process against Gaussians of the stated covariance."""

import numpy as np
import pytest
import torch
from scipy.stats import multivariate_normal

from sbi_active import GaussianNoise
from sbi_active.criticism import Trials
from sbi_active.criticism.data.measurements import Measurements
from sbi_active.criticism.rivals.error_models import (
    NoiseCell,
    NoiseGrid,
    declared_noise,
)
from sbi_active.criticism.rivals.residual_process import TIME_LENGTH, ResidualProcess

ACTION = torch.linspace(-2, 2, 8)[:, None]
X = torch.tensor([0.3, 1.4, -0.2, 0.8, 2.2, 1.1, 3.5, 2.9])[:, None]
XI = ACTION[:, 0].double().numpy()
AMPLITUDES = np.geomspace(1, 20, 10)


M = Measurements.of(Trials(ACTION, X))
R, PLACE = X[:, 0].double().numpy(), ACTION.double().numpy() / 4
AT = {"largest": 20.0, "lengths": (0.3,)}


def covariance(points, others):
    """Return the kernel of two sets of places, shape (n, m)."""
    return np.exp(-0.5 * ((points[:, None] - others) / 0.3) ** 2)


KERNEL = covariance(PLACE[:, 0], PLACE[:, 0])


def mixed(covariances, r=R):
    """Return the log of the mean density of Gaussians."""
    each = [multivariate_normal(cov=cov).logpdf(r) for cov in covariances]
    return np.logaddexp.reduce(each) - np.log(len(each))


SPREAD = np.exp(3 * XI)


@pytest.mark.parametrize("spread", [None, SPREAD])
def test_the_residual_process_is_a_gaussian_of_the_stated_covariance(spread):
    """It may grow with the prediction."""
    noise = declared_noise(GaussianNoise(0.5), M)
    process = ResidualProcess(noise, M, action=PLACE, spread=spread, **AT)
    sizes = [np.full(8, 0.5)]
    if spread is not None:
        sizes.append(spread * np.median(0.5 / spread))
    expected = mixed(
        a**2 * KERNEL * np.outer(b, b) + 0.25 * np.eye(8)
        for a in AMPLITUDES
        for b in sizes
    )
    # Directions below 1e-5 of the variance are left out.
    assert process.log_likelihood(R[None])[0] == pytest.approx(expected, abs=1e-2)


def test_one_process_follows_the_order_of_the_trials():
    noise, order = declared_noise(GaussianNoise(0.5), M), np.arange(8) / 7
    action = np.random.default_rng(0).permutation(PLACE)
    each = [
        ResidualProcess(noise, M, action=place, **AT).log_likelihood(R[None])[0]
        for place in (action, order[:, None])
    ]
    both = ResidualProcess(noise, M, action=action, order=order, **AT)
    expected = np.logaddexp(*each) - np.log(2)
    assert both.log_likelihood(R[None])[0] == pytest.approx(expected)
    # A slow drift is carried on for a while.
    drift, later = 4 * np.sin(2 * order), np.append(order, order[-1] + 0.05)
    there = np.concatenate([action, action[:1]])
    one = Measurements.of(Trials(ACTION[:1], X[:1]))
    mean, _ = both.condition(drift[None], one, there, order=later)
    assert mean[0, 0] == pytest.approx(4 * np.sin(2 * later[-1]), abs=0.5)


def test_the_best_process_is_interpolated_with_its_own_uncertainty():
    # Half of the deviation and a factor of two.
    noise = NoiseGrid([NoiseCell.of(M, sd=np.full(8, 0.25))], scales=np.array([2.0]))
    process = ResidualProcess(noise, M, action=PLACE, **AT)

    def total(a):
        return 0.25 * (a**2 * KERNEL + np.eye(8))

    there = np.array([-0.45, 0.1, 0.3])
    new = Measurements.of(Trials(4 * there[:, None], np.zeros((3, 1))))
    everywhere = np.concatenate([PLACE, there[:, None]])
    mean, sd = process.condition(np.stack([R, 2 * R]), new, everywhere)
    # The amplitude is that of the mean residual, 1.5 r.
    best = max(process.amplitudes, key=lambda a: mixed([total(a)], 1.5 * R))
    assert best > AMPLITUDES[0]
    across = 0.25 * best**2 * covariance(there, PLACE[:, 0])
    weight = across @ np.linalg.inv(total(best))
    np.testing.assert_allclose(mean, np.stack([weight @ R, 2 * weight @ R]), rtol=1e-6)
    variance = 0.25 * best**2 - np.einsum("mi,mi->m", weight, across)
    np.testing.assert_allclose(sd**2, variance, rtol=1e-6)


def test_trajectories_are_smooth_in_action_and_time():
    x = np.random.default_rng(0).normal(size=(3, 5))
    times = np.linspace(0, 1, 5)
    m = Measurements.of(Trials([0.0, 1.0, 2.0], x, sample_times=times))
    noise = NoiseGrid([NoiseCell.of(m, sd=np.full(15, 0.3), correlation_time=0.2)])
    place = np.array([[0.0], [0.2], [1.0]])
    process = ResidualProcess(noise, m, action=place, **AT)
    apart = (place[m.trial] - place[m.trial].T) / 0.3
    later, same = m.time[:, None] - m.time, m.trial[:, None] == m.trial
    smooth = np.exp(-0.5 * apart**2 - 0.5 * (later / TIME_LENGTH) ** 2)
    rough = np.where(same, np.exp(-np.abs(later) / 0.2), 0.0)
    expected = mixed((0.09 * (a**2 * smooth + rough) for a in AMPLITUDES), m.x)
    assert process.log_likelihood(m.x[None])[0] == pytest.approx(expected, abs=2e-2)

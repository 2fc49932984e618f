"""Gaussian processes on few simulations."""

import numpy as np

from sbi_active.inference.sampling.gaussian_process import GaussianProcess


def test_a_trend_of_ten_thousand_deviations_is_known_to_one():
    rng = np.random.default_rng(0)
    slope = np.array([[1.5e4, -3.0], [5.0, 2.0]])
    u, new = rng.uniform(-1, 1, (20, 2)), rng.uniform(-1, 1, (50, 2))

    def f(u):
        return (u @ slope + [7.0, 1.0] + np.sin(3 * u)).astype(np.float32)

    process = GaussianProcess.fit(u, f(u).astype(float), noise="none")
    mean, variance = process.predict(new)
    assert np.abs(mean - f(new)).max() < 0.5
    assert np.array_equal(process.mean(new), mean)
    assert np.sqrt(variance).max() < 0.7
    assert np.abs(process.left_out).max() < 0.5

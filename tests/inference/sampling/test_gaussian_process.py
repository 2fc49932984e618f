"""Gaussian processes on few simulations."""

import numpy as np
import pytest

from sbi_active.inference.sampling.gaussian_process import (
    GaussianProcess,
    ProcessSettings,
)


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


def test_what_is_no_trend_is_interpolated_with_its_error():
    rng = np.random.default_rng(1)
    u, new = rng.uniform(-1, 1, (30, 1)), rng.uniform(-1, 1, (200, 1))
    process = GaussianProcess.fit(u, np.sin(9 * u), noise="none")
    mean, variance = process.predict(new)
    off = (mean - np.sin(9 * new)) / np.sqrt(variance)
    assert np.abs(mean - np.sin(9 * new)).max() < 0.05
    assert np.quantile(np.abs(off), 0.95) < 3
    far = process.predict(np.array([[4.0]]))
    assert float(np.sqrt(far[1][0, 0])) > 0.5


def test_a_trend_of_fewer_features_misses_left_out_rows_by_less():
    rng = np.random.default_rng(3)
    u = rng.uniform(-1, 1, (150, 10))
    y = 3 * u[:, :1] + 0.5 * rng.standard_normal((150, 1))
    given, linear = (
        GaussianProcess.fit(
            u, y, noise="learned", settings=ProcessSettings(degree=degree)
        )
        for degree in (None, 1)
    )
    assert (given.settings.degree, linear.settings.degree) == (2, 1)
    missed = [np.sqrt((p.left_out**2).mean()) for p in (given, linear)]
    assert missed[1] == pytest.approx(0.5, rel=0.15)
    assert missed[0] > 1.2 * missed[1]

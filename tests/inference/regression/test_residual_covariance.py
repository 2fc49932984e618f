"""The covariance of residuals, against that of many rows and its formula."""

import numpy as np
import pytest

from sbi_active.inference.regression.residuals import (
    ResidualCovariance,
    alike,
)

TRIAL = np.array([0, 0, 1, 1])
DEVIATION = np.array([1.0, 10.0, 0.1, 2.0])
WITHIN = np.array(
    [
        [1.0, 0.8, 0.0, 0.0],
        [0.8, 1.0, 0.0, 0.0],
        [0.0, 0.0, 1.0, -0.5],
        [0.0, 0.0, -0.5, 1.0],
    ]
)


def standardized(correlation, num, seed=0):
    factor = np.linalg.cholesky(correlation)
    return np.random.default_rng(seed).normal(size=(num, len(factor))) @ factor.T


def test_many_rows_leave_the_correlations_as_they_are():
    z = standardized(WITHIN, 40_000)
    found = ResidualCovariance.of(z, DEVIATION, 40_000, TRIAL)
    exact = DEVIATION[:, None] * WITHIN * DEVIATION
    assert len(found.blocks) == 2
    inverse_root = found.whiten(np.eye(4))
    inverse = DEVIATION[:, None] * (inverse_root @ inverse_root.T) * DEVIATION
    np.testing.assert_allclose(inverse @ WITHIN, np.eye(4), atol=0.05)
    white = found.whiten(z * DEVIATION)
    np.testing.assert_allclose(white.T @ white / 40_000, np.eye(4), atol=0.03)
    assert found.log_volume == pytest.approx(
        0.5 * np.linalg.slogdet(exact)[1], abs=0.05
    )
    assert found.precision == pytest.approx(1, abs=1e-3)


def test_the_inverse_is_unbiased_where_nothing_shrinks():
    # A third of the rows' number: the inverse is half again too large on average.
    correlation = 0.9 + 0.1 * np.eye(8)
    trial, total, plain = np.zeros(8, dtype=int), [], []
    for seed in range(300):
        z = standardized(correlation, 24, seed)
        deviation = np.sqrt((z**2).sum(0) / 24)
        own = z / deviation
        found = ResidualCovariance.of(own, deviation, 24, trial)
        root = found.whiten(np.eye(8))
        plain.append(np.trace(root @ root.T @ correlation) / 8)
        total.append(found.precision * plain[-1])
    assert np.mean(plain) > 1.2
    assert abs(np.mean(total) - 1) < abs(np.mean(plain) - 1)


@pytest.mark.parametrize("num", [30, 3_000])
def test_outcomes_that_vary_as_one_are_counted(num):
    apart = standardized(np.eye(40), num)
    assert alike(apart, num) == pytest.approx(1, abs=0.5)
    together = standardized(
        np.kron(np.eye(4), np.ones((10, 10))) + 1e-9 * np.eye(40), num
    )
    assert alike(together, num) == pytest.approx(10, rel=0.4)

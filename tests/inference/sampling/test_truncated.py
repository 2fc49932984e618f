"""Normal variables between bounds, in the tails too, against SciPy."""

import numpy as np
import pytest
from scipy.stats import norm, truncnorm

from sbi_active.inference.sampling.truncated import log_inside, truncated_normal

LOW = np.array([-1.0, 3.0, -np.inf, -9.0, -np.inf])
HIGH = np.array([2.0, 8.0, -6.0, np.inf, np.inf])


def test_probability_between_bounds():
    one = np.ones(5)
    expected = np.log(norm.sf((LOW - 1) / 2) - norm.sf((HIGH - 1) / 2))
    assert log_inside(one, 2 * one, LOW, HIGH) == pytest.approx(expected)
    far = log_inside(one[:1], one[:1], np.array([31.0]), np.array([41.0]))
    assert far[0] == pytest.approx(norm.logsf(30.0))


def test_draws_between_bounds():
    rng = np.random.default_rng(0)
    for low, high in zip(LOW, HIGH, strict=True):
        ends = np.full(4_000, low), np.full(4_000, high)
        draws = truncated_normal(np.ones(4_000), np.full(4_000, 2.0), *ends, rng)
        own = truncnorm((low - 1) / 2, (high - 1) / 2, 1, 2)
        assert (low <= draws).all()
        assert (draws <= high).all()
        assert draws.mean() == pytest.approx(own.mean(), abs=4 * own.std() / 60)

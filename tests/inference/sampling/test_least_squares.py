"""Least squares within bounds, against SciPy's."""

import numpy as np
import pytest
from scipy.optimize import nnls

from sbi_active.inference.sampling.least_squares import within


@pytest.mark.parametrize("seed", range(5))
def test_steps_along_bounds_end_where_the_bounded_least_squares_is(seed):
    rng = np.random.default_rng(seed)
    matrix = rng.normal(size=(20, 5)) + rng.normal(size=(20, 1))
    target = rng.normal(size=20)
    low, high = np.zeros(5), np.full(5, np.inf)
    system, right = (matrix.T @ matrix)[None], matrix.T @ target
    u = np.zeros((1, 5))
    for _ in range(20):
        gradient = (system[0] @ u[0] - right)[None]
        u = np.clip(u - within(system, gradient, u, low, high), low, high)
    assert u[0] == pytest.approx(nnls(matrix, target)[0], abs=1e-9)
    assert (u[0] == 0).any()  # or the bounds would not matter

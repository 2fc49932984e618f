"""Refits without a part of the trials stay within bounds, and are the best there."""

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from sbi_active.criticism.misfit.left_out import bounded


@pytest.mark.parametrize("seed", range(20))
def test_the_best_within_bounds_is_that_of_scipy(seed):
    rng = np.random.default_rng(seed)
    dim = 8
    matrix = rng.normal(size=(30, dim)) + 2 * rng.normal(size=(30, 1))
    target = rng.normal(size=30)
    low = np.where(rng.random(dim) < 0.7, 0.0, -np.inf)
    high = np.where(rng.random(dim) < 0.4, 0.1, np.inf)
    system, right = (matrix.T @ matrix)[None], (matrix.T @ target)[None]
    x = bounded(system, right, low, high)[0]
    best = lsq_linear(matrix, target, (low, high), tol=1e-13).x

    def square(x):
        return float(((matrix @ x - target) ** 2).sum())

    assert (x >= low).all()
    assert (x <= high).all()
    assert square(x) == pytest.approx(square(best), abs=1e-9)


def test_where_no_bound_matters_it_is_the_plain_solution():
    rng = np.random.default_rng(0)
    matrix = rng.normal(size=(3, 9, 4))
    system = np.einsum("nij,nik->njk", matrix, matrix)
    right = rng.normal(size=(3, 4))
    far = np.full(4, 1e6)
    plain = np.linalg.solve(system, right[..., None])[..., 0]
    assert (bounded(system, right, -far, far) == plain).all()

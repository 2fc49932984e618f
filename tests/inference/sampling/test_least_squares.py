"""Least squares within bounds, against SciPy's."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import lsq_linear, nnls

from sbi_active.inference.sampling.least_squares import descend, within


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


@pytest.mark.parametrize("seed", range(10))
def test_one_step_from_within_ends_at_the_bounded_least_squares(seed):
    rng = np.random.default_rng(seed)
    matrix = rng.normal(size=(12, 4)) + 2 * rng.normal(size=(12, 1))
    target = 3 * rng.normal(size=12)
    low, high = np.full(4, -0.3), np.full(4, 0.4)
    u = rng.uniform(-0.3, 0.4, (1, 4))
    system = (matrix.T @ matrix)[None]
    gradient = (system[0] @ u[0] - matrix.T @ target)[None]
    found = (u - within(system, gradient, u, low, high))[0]
    expected = lsq_linear(matrix, target, (low, high), method="bvls").x
    assert found == pytest.approx(expected, abs=1e-9)


def test_a_valley_that_leads_to_a_bound_is_followed_there():
    """The step beyond it, clipped alone, would climb out of the valley."""

    def residual(u):
        return (np.stack([30 * (u[:, 0] + 0.1 * u[:, 1]), 0.3 * (u[:, 1] - 9)], 1),)

    def jacobian(u, whiten, step):
        slopes = np.array([[30.0, 3.0], [0.0, 0.3]])
        return residual(u)[0], np.repeat(slopes[None], len(u), 0)

    bounds = SimpleNamespace(
        low=np.full(2, -2.0),
        high=np.full(2, 2.0),
        center=np.zeros(2),
        precision=np.zeros(2),
    )
    problem = SimpleNamespace(
        dim=2,
        coordinates=bounds,
        searched=np.ones(2, dtype=bool),
        residual=residual,
        jacobian=jacobian,
    )
    u, _ = descend(problem, np.array([[0.0, 0.0]]), lambda r: r, 1e-3, 10)
    assert u[0] == pytest.approx([-0.2, 2.0], abs=1e-2)

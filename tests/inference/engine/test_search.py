"""Modes and widths by Gauss-Newton steps, where both are known."""

import numpy as np

from sbi_active.inference.engine.search import WIDER, search
from tests.inference.engine.potentials import Given


def test_a_linear_model_has_one_mode_of_the_posterior_width():
    rng = np.random.default_rng(0)
    matrix, truth = rng.standard_normal((12, 4)) * 5, rng.standard_normal(4)
    x = matrix @ truth + rng.standard_normal(12)
    found = search(Given(lambda u: x - u @ matrix.T, 4, 12), rng)
    precision = matrix.T @ matrix + np.eye(4)
    assert found is not None
    assert found.modes.shape == (1, 4)
    mean = np.linalg.solve(precision, matrix.T @ x)
    sd = np.sqrt(np.diag(np.linalg.inv(precision)))
    assert (np.abs(found.modes[0] - mean) < 0.05 * sd).all()
    factor = found.guess.factors[0] / WIDER
    np.testing.assert_allclose(
        factor @ factor.T, np.linalg.inv(precision), rtol=1e-3, atol=1e-6
    )
    assert found.informed.all()


def test_every_mode_is_found():
    # u^2 is seen: each sign of each coordinate explains it.
    x = np.array([1.0, 0.64, 1.44])
    residuals = Given(lambda u: (x - u**2) / 0.02, 3, 3)
    found = search(residuals, np.random.default_rng(1))
    assert found is not None
    signs = {tuple(np.sign(mode)) for mode in found.modes}
    assert len(signs) == 8
    np.testing.assert_allclose(np.abs(found.modes), np.tile(x**0.5, (8, 1)), atol=0.01)


def test_fewer_numbers_than_parameters_leave_the_prior_where_nothing_is_known():
    residuals = Given(lambda u: (2.0 - u[:, :1]) / 0.1, 5, 1)
    found = search(residuals, np.random.default_rng(2))
    assert found is not None
    np.testing.assert_array_equal(found.informed, [True, *[False] * 4])
    sd = np.sqrt(np.diag(found.guess.factors[0] @ found.guess.factors[0].T)) / WIDER
    np.testing.assert_allclose(sd[1:], 1.0, rtol=1e-3)
    np.testing.assert_allclose(sd[0], 1 / np.sqrt(101), rtol=1e-2)


def test_where_nothing_fits_there_is_a_best_place():
    """Beside a sum of squares of 1e18 some nats are lost in the rounding."""
    own = Given(lambda u: 1e9 + np.stack([u[:, 0], 3 * u[:, 1]], 1), 2, 2)
    found = search(own, np.random.default_rng(0))
    assert len(found.modes) >= 1
    assert np.isfinite(found.guess.factors).all()

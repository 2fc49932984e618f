"""Local regressions: density, misfit against noise, shrinkage."""

from __future__ import annotations

import numpy as np
import pytest

from sbi_active.inference.regression.regions import whole_space
from sbi_active.inference.regression.surrogate import LocalRegression, estimate_noise

NUM = 400


def regress(curve, *, noise: float = 0.1, q: int = 3, num_trials: int = 1):
    rng = np.random.default_rng(0)
    z = rng.uniform(-1, 1, (NUM, 2))
    weight = rng.standard_normal((2, q))
    x = curve(z) @ weight + noise * rng.standard_normal((NUM, q))
    pairs = noise * rng.standard_normal((2, 80, q))
    estimate = estimate_noise(pairs[0], pairs[1], np.ones(q))
    fit = LocalRegression.fit(
        whole_space(2), z, x, noise=estimate, num_trials=num_trials
    )
    return fit, weight


@pytest.mark.parametrize("q", [1, 3, 12])
def test_likelihood_of_a_linear_model(q: int):
    fit, weight = regress(lambda z: z, q=q)
    z = np.random.default_rng(1).uniform(-0.5, 0.5, (50, 2)) * 0.1
    # The observation is the origin, since outcomes are given less the observed ones.
    square = ((z @ weight) ** 2).sum(1) / 0.1**2
    exact = -0.5 * square - 0.5 * q * np.log(2 * np.pi * 0.1**2)
    # q variances, each from some 400 residuals, and 3 coefficients a outcome.
    error = np.sqrt(q / 2 / NUM) + np.sqrt(3 * square.max() / NUM)
    assert abs(fit.log_likelihood(z) - exact).max() < 4 * error
    assert not fit.has_misfit
    assert fit.caution() == 1


def test_misfit_is_told_from_noise():
    # No polynomial or smooth wave follows a step.
    fit, _ = regress(lambda z: np.sign(z - 0.1))
    assert fit.has_misfit
    assert fit.ratio > 3
    assert fit.caution() >= 2

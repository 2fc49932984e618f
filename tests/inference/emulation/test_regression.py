"""Regressions, and what few simulations cost a belief."""

from __future__ import annotations

import numpy as np
import pytest

from sbi_active.inference.emulation.regression import Regression
from sbi_active.inference.emulation.solving import around, whole_space

NUM = 400


def regress(curve, *, noise: float = 0.1, q: int = 3, num: int = NUM, seed: int = 0):
    """Return the regression of q numbers of two parameters, and their weights."""
    rng = np.random.default_rng(seed)
    weight = np.random.default_rng(q).standard_normal((2, q))
    z = rng.uniform(-1, 1, (num, 2))
    z = np.concatenate([z, z[: num // 5]])
    x = curve(z) @ weight + noise * rng.standard_normal((len(z), q))
    pairs = np.stack([np.arange(num // 5), num + np.arange(num // 5)], 1)
    trial, observed = np.zeros(q, dtype=int), np.zeros(q)
    return Regression.fit(whole_space(2), z, x, pairs, trial, observed), weight


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


@pytest.mark.parametrize("num", [100, 400])
def test_expected_error_is_the_mean_divergence(num: int):
    expected, actual = [], []
    for seed in range(20):
        fit, weight = regress(lambda z: z, noise=1.0, q=4, num=num, seed=seed)
        rng = np.random.default_rng(1_000 + seed)
        precision = weight @ weight.T + 10 * np.eye(2)
        factor = np.linalg.cholesky(np.linalg.inv(precision))
        draws = rng.standard_normal((2_000, 2)) @ factor.T
        expected.append(fit.error(draws, rng))
        # KL(exact || belief), the normalizer by importance sampling from the exact.
        ratio = fit.log_likelihood(draws) + 0.5 * ((draws @ weight) ** 2).sum(1)
        top = ratio.max()
        actual.append(np.log(np.exp(ratio - top).mean()) + top - ratio.mean())
    error = np.std(actual) / len(actual) ** 0.5
    assert np.mean(expected) == pytest.approx(np.mean(actual), rel=0.3, abs=3 * error)


def test_distant_simulations_count_where_the_response_is_simple():
    rng = np.random.default_rng(0)
    near, far = 0.1 * rng.standard_normal((200, 1)), rng.uniform(-1, 1, (200, 1))
    z, none = np.concatenate([near, far]), np.zeros((0, 2), dtype=int)
    region = around(0.03 * rng.standard_normal((500, 1)))
    reaches = {}
    for curve in (lambda z: z, lambda z: np.sign(z) * (np.abs(z) > 0.4) + z):
        x = curve(z) + 0.05 * rng.standard_normal(z.shape)
        fit = Regression.fit(region, z, x, none, np.zeros(1, dtype=int), np.zeros(1))
        reaches[curve] = fit.basis.reach * 0.03
    near, far = sorted(reaches.values())
    assert list(reaches.values()) == [far, near]
    assert near < 0.6 < far

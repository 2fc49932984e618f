"""Student-t mixtures against SciPy's density and closed-form moments."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import multivariate_t

from sbi_active.inference.sampling.mixtures import StudentMixture, lower_factors

MEANS = np.array([[-3.0, 0.0], [3.0, 1.0]])
FACTORS = np.array([[[1.0, 0.0], [0.8, 0.5]], [[0.3, 0.0], [-0.1, 0.2]]])
WEIGHTS = np.array([0.25, 0.75])
Z = np.random.default_rng(0).normal(size=(2_500, 2)) * 3


def density(weights: np.ndarray, inflation: float = 1.0) -> np.ndarray:
    """Return SciPy's density at Z."""
    triples = zip(weights, MEANS, FACTORS, strict=True)
    return sum(
        w * multivariate_t(m, inflation * f @ f.T, df=5).pdf(Z) for w, m, f in triples
    )


def test_the_density_is_scipy_s():
    mixture = StudentMixture(MEANS, FACTORS, WEIGHTS)
    assert mixture.log_prob(Z) == pytest.approx(np.log(density(WEIGHTS)))
    even = StudentMixture(MEANS, FACTORS)
    assert even.log_prob(Z) == pytest.approx(np.log(density(np.full(2, 0.5))))


def test_a_split_mixture_is_normalized_and_matches_its_draws():
    rng = np.random.default_rng(0)
    axes = FACTORS @ np.array([[0.8, -0.6], [0.6, 0.8]])
    left, right = np.array([[1.0, 1.0], [2.0, 1.0]]), np.array([[3.0, 1.0], [1.0, 0.5]])
    split = StudentMixture(MEANS, axes, WEIGHTS, 7.0, left, right)
    wide = StudentMixture(MEANS, 4 * FACTORS, WEIGHTS)
    z = wide.sample(200_000, rng)
    ratio = np.exp(split.log_prob(z) - wide.log_prob(z))
    error = ratio.std() / len(z) ** 0.5
    assert ratio.mean() == pytest.approx(1.0, abs=4 * error)
    draws = split.sample(200_000, rng)
    for region in (lambda u: u[:, 0] > 3.0, lambda u: u[:, 1] > u[:, 0]):
        expected = (ratio * region(z)).mean()
        assert region(draws).mean() == pytest.approx(expected, abs=0.02)


def test_a_singular_covariance_has_its_smallest_variances_raised():
    covariance = np.array([[1.0, 1.0], [1.0, 1.0]])[None] - 1e-16
    covariance = np.concatenate([covariance, [[[1.0, 2.0], [2.0, 1.0]]]])
    factor = lower_factors(covariance)
    assert (np.triu(factor, 1) == 0).all()
    assert (np.diagonal(factor, axis1=1, axis2=2) > 0).all()
    assert (factor @ np.swapaxes(factor, 1, 2))[0] == pytest.approx(
        covariance[0], abs=1e-9
    )

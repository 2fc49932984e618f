"""Evidences and moments of densities whose integral is known."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal, norm

from sbi_active.inference.sampling.mixtures import StudentMixture
from sbi_active.inference.sampling.smc import bridge


def standard(u):
    return norm.logpdf(u).sum(1)


def mixture(*means, sd=1.0):
    means = np.array(means, dtype=float)
    factors = np.stack([sd * np.eye(means.shape[1])] * len(means))
    return StudentMixture(means, factors, freedom=np.inf)


def test_two_modes_keep_their_masses():
    def likelihood(u):
        parts = [multivariate_normal.logpdf(u, [m, 0], 0.04) for m in (-2, 1)]
        return np.logaddexp(*parts)

    found = bridge(
        standard,
        likelihood,
        mixture([-2, 0], [1, 0], sd=0.3),
        np.random.default_rng(0),
        num_particles=4_000,
    )
    masses = [
        multivariate_normal.pdf([m, 0], [0, 0], 1.04 * np.eye(2)) for m in (-2, 1)
    ]
    assert abs(found.log_evidence - np.log(sum(masses))) < 4 * found.standard_error
    share = (found.u[:, 0] < -0.5).mean()
    assert share == pytest.approx(masses[0] / sum(masses), abs=0.05)


def test_too_few_evaluations_are_no_answer():
    found = bridge(
        standard,
        lambda u: norm.logpdf(1.0, u, 0.01).sum(1),
        mixture([-3.0], sd=0.1),
        np.random.default_rng(0),
        num_particles=500,
        most=600,
    )
    assert found is None

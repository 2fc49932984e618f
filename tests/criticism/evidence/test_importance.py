"""Importance sampling of the evidence, against closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from sbi_active.criticism.evidence.importance import (
    ROUND,
    importance_sample,
    lower_factors,
)
from sbi_active.inference.sampling.student_mixture import StudentMixture
from tests.criticism.evidence.linear import exact, linear_rival


def start(width: float) -> StudentMixture:
    return StudentMixture(np.zeros((1, 2)), width * np.eye(2)[None])


@pytest.mark.parametrize("width", [0.3, 1.0])
def test_the_evidence_and_the_posterior_come_from_any_start(width):
    rival, closed = linear_rival(), exact()
    sample = importance_sample(
        rival, start(width), rng=np.random.default_rng(0), enough=1_000.0
    )
    assert 0 < sample.standard_error < 0.1
    assert sample.log_evidence == pytest.approx(
        closed.log_evidence, abs=4 * sample.standard_error
    )
    z = rival.coordinates.to_z(sample.u)
    mean = sample.weights @ z
    deviation = np.sqrt(np.diag(closed.covariance))
    assert (abs(mean - closed.mean) < 0.2 * deviation).all()
    covariance = ((z - mean) * sample.weights[:, None]).T @ (z - mean)
    assert covariance == pytest.approx(closed.covariance, abs=0.01)


def test_the_standard_error_claims_no_less_than_repeated_runs_show():
    rival, closed = linear_rival(), exact()
    found = [
        importance_sample(rival, start(0.5), rng=np.random.default_rng(seed))
        for seed in range(30)
    ]
    gap = np.array([s.log_evidence for s in found]) - closed.log_evidence
    claimed = np.mean([s.standard_error for s in found])
    # More than they show, since each particle is weighted by all proposals.
    assert 0.2 * claimed < np.sqrt((gap**2).mean()) < 1.2 * claimed


def test_a_model_far_behind_ends_with_fewer_particles():
    rival = linear_rival()

    def rows(dismissed: float) -> int:
        rng = np.random.default_rng(1)
        return len(importance_sample(rival, start(1.0), rng=rng, dismissed=dismissed).u)

    assert rows(1e3) < rows(-np.inf)


@pytest.mark.parametrize(("above", "rounds"), [(40.0, 8), (-np.inf, 30)])
def test_a_hopeless_model_ends_once_its_shape_was_looked_at(above, rounds):
    """However few particles are effective; here more are asked for than any has."""
    rng, hopeless = np.random.default_rng(1), exact().log_evidence + above
    sample = importance_sample(
        linear_rival(), start(1.0), rng=rng, enough=1e9, hopeless=hopeless
    )
    assert len(sample.u) == rounds * ROUND


def test_a_first_round_that_looked_well_is_doubted_once_the_next_ones_are_poor():
    """All its draws lie where the likelihood is flat; what counts is far from them."""
    rival, asked = linear_rival(), []

    def two(u):
        near = -0.5 * ((u / 0.4) ** 2).sum(1)
        far = 200.0 - 0.5 * (((u - 8.0) / 0.05) ** 2).sum(1)
        return np.logaddexp(near, far)

    rival.log_likelihood = two  # type: ignore[method-assign]

    def local(sample, number):
        asked.append(number)
        return StudentMixture(np.full((1, 2), 8.0), 0.02 * np.eye(2)[None])

    # No draw of the first round is of its second part, of a later one many are.
    first = StudentMixture(
        np.array([[0.0, 0.0], [8.0, 8.0]]),
        np.stack([np.eye(2), 0.3 * np.eye(2)]),
        np.array([0.996, 0.004]),
    )
    sample = importance_sample(
        rival, first, rng=np.random.default_rng(1), local=local, enough=60.0
    )
    assert 0 < asked[0] < 7
    assert (sample.weights @ sample.u) == pytest.approx([7.98, 7.98], abs=0.02)


def test_a_likelihood_of_zero_has_no_evidence():
    rival = linear_rival()
    rival.log_likelihood = lambda u: np.full(len(u), -np.inf)  # type: ignore[method-assign]
    sample = importance_sample(rival, start(1.0), rng=np.random.default_rng(0))
    assert sample.log_evidence == -np.inf
    assert sample.effective_sample_size == 0
    assert sample.weights.sum() == pytest.approx(1)


def test_lower_factors_are_those_of_cholesky():
    a = np.random.default_rng(0).normal(size=(3, 4, 4))
    covariance = a @ np.swapaxes(a, 1, 2)
    assert (lower_factors(covariance) == np.linalg.cholesky(covariance)).all()


def test_a_singular_covariance_has_its_smallest_variances_raised():
    covariance = np.array([[1.0, 1.0], [1.0, 1.0]])[None] - 1e-16
    covariance = np.concatenate([covariance, [[[1.0, 2.0], [2.0, 1.0]]]])
    factor = lower_factors(covariance)
    assert (np.triu(factor, 1) == 0).all()
    assert (np.diagonal(factor, axis1=1, axis2=2) > 0).all()
    assert (factor @ np.swapaxes(factor, 1, 2))[0] == pytest.approx(
        covariance[0], abs=1e-9
    )

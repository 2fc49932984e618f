"""Tempered sequential Monte Carlo, against closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from sbi_active.criticism.evidence.tempering import temper
from tests.criticism.evidence.linear import exact, linear_rival


def test_tempering_gives_the_evidence_and_the_posterior():
    rival, closed = linear_rival(), exact()
    found = [temper(rival, seed=seed) for seed in range(4)]
    error = np.mean([sample.standard_error for sample in found])
    assert error < 0.3
    mean = np.mean([sample.log_evidence for sample in found])
    assert mean == pytest.approx(closed.log_evidence, abs=2 * error)
    z = np.concatenate([rival.coordinates.to_z(sample.u) for sample in found])
    deviation = np.sqrt(np.diag(closed.covariance))
    assert (abs(z.mean(0) - closed.mean) < 0.2 * deviation).all()
    assert np.cov(z.T) == pytest.approx(closed.covariance, abs=0.15 * deviation.max())


def test_a_seed_gives_the_same_particles():
    one, two = (temper(linear_rival(), seed=3, num_particles=50) for _ in range(2))
    assert (one.u == two.u).all()
    assert one.log_evidence == two.log_evidence


def test_a_likelihood_without_mass_gives_no_evidence():
    rival = linear_rival()
    rival.log_likelihood = lambda u: -1e30 * (1 + abs(u[:, 0]))  # type: ignore[method-assign]
    assert temper(rival, seed=0, num_particles=20).log_evidence == -np.inf

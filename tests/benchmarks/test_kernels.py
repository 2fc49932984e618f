"""Kernels around draws of which few are distinct."""

import numpy as np
import pytest

from benchmarks.location_finding.kernels import KernelProposal
from sbi_active.inference.sampling.student_mixture import StudentMixture


@pytest.mark.parametrize("dim", [8, 20])
@pytest.mark.parametrize("num", [1, 2, 5])
@pytest.mark.parametrize("size", [1e-3, 1.0, 1e3])
def test_fewer_draws_than_parameters_have_kernels(dim, num, size):
    rng = np.random.default_rng(0)
    base = StudentMixture(np.zeros((1, dim)), size * np.eye(dim)[None])
    z = size * rng.standard_normal((num, dim))
    proposal = KernelProposal.around(z, np.full(num, 1 / num), base, rng)
    drawn = proposal.sample(200, rng)
    assert np.isfinite(drawn).all()
    assert np.isfinite(proposal.log_prob(drawn)).all()

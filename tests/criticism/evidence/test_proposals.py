"""Where importance sampling proposes again, against a Gaussian posterior."""

import numpy as np
import pytest

from sbi_active.criticism.evidence.importance import (
    LOOKS,
    ImportanceSample,
    importance_sample,
)
from sbi_active.criticism.evidence.least_squares import find_modes
from sbi_active.criticism.evidence.proposals import (
    POWER,
    _tempered,
    regressions,
    ridges,
)
from sbi_active.inference.sampling.student_mixture import StudentMixture
from tests.criticism.evidence.linear import exact, linear_rival

STEP = 1e-4


def some_sample(rival, rng, *, effective=50.0):
    u = rival.coordinates.sample(600, seed=1)
    log_p = rival.log_likelihood(u)
    weights = np.exp(log_p - log_p.max())
    return ImportanceSample(u, weights / weights.sum(), 0.0, 0.1, effective)


def test_tempered_weights_are_a_power_that_leaves_so_many_effective():
    target = np.append(-0.5 * np.linspace(0, 40, 200) ** 2, -np.inf)
    weights = _tempered(target, 30.0)
    assert 1 / (weights**2).sum() == pytest.approx(30.0, rel=1e-2)
    assert weights[-1] == 0
    power = np.log(weights[50] / weights[0]) / target[50]
    assert np.log(weights[80] / weights[0]) == pytest.approx(power * target[80])
    flat = _tempered(np.zeros(50), 30.0)
    assert flat == pytest.approx(1 / 50)


def test_a_regression_proposes_the_tempered_posterior():
    rival, closed, rng = linear_rival(), exact(), np.random.default_rng(0)
    modes = find_modes(rival, step=STEP, seed=0)
    proposal = regressions(rival, modes, STEP, rng)(some_sample(rival, rng), 0)
    c = rival.coordinates
    means = c.to_z(proposal.means)
    deviation = np.sqrt(np.diag(closed.covariance))
    assert (abs(means.mean(0) - closed.mean) < deviation).all()
    # The likelihood counts with a power of .6, of which the prior is a small part.
    assert means.std(0) == pytest.approx(deviation / np.sqrt(POWER), rel=0.5)


def test_a_proposal_again_gives_the_evidence():
    rival, closed, rng = linear_rival(), exact(), np.random.default_rng(0)
    modes = find_modes(rival, step=STEP, seed=0)
    far = StudentMixture(np.full((1, 2), 3.0), 0.1 * np.eye(2)[None])
    for kind in (ridges, regressions):
        local = kind(rival, modes, STEP, rng)
        found = importance_sample(rival, far, rng=rng, local=local)
        error = 4 * found.standard_error
        assert error < 0.6
        assert found.log_evidence == pytest.approx(closed.log_evidence, abs=error)


def test_where_regressions_keep_failing_ridges_take_over():
    rival, rng = linear_rival(), np.random.default_rng(0)
    modes = find_modes(rival, step=STEP, seed=0)
    sizes = []
    for number, effective in ((LOOKS[-1], 2.0), (LOOKS[-1], 50.0), (0, 2.0)):
        local = regressions(rival, modes, STEP, np.random.default_rng(1))
        sample = some_sample(rival, rng, effective=effective)
        sizes.append(len(local(sample, number).means))
    assert sizes[1] == sizes[2] == 40  # kernels of a regression
    assert sizes[0] != 40

"""Modes by least squares, against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import nnls

from sbi_active.criticism.evidence.importance import INFLATION
from sbi_active.criticism.evidence.least_squares import (
    ROUGH,
    THOROUGH,
    along_ridges,
    find_modes,
    local_proposal,
)
from sbi_active.inference.sampling.least_squares import within
from tests.criticism.evidence.linear import exact, linear_rival

STEP = 1e-4


@pytest.mark.parametrize("search", [THOROUGH, ROUGH])
def test_the_mode_of_a_linear_model_is_the_posterior_s(search):
    rival, closed = linear_rival(), exact()
    modes = find_modes(rival, step=STEP, seed=0, search=search)
    assert len(modes.u) == 1
    z = rival.coordinates.to_z(modes.u)[0]
    deviation = np.sqrt(np.diag(closed.covariance))
    # The prior's moments in the search are those of 1,000 draws.
    assert (abs(z - closed.mean) < 0.1 * deviation).all()


def test_the_proposal_has_the_posterior_s_covariance():
    rival, closed = linear_rival(), exact()
    modes = find_modes(rival, step=STEP, seed=0)
    factor = rival.coordinates.scale[:, None] * modes.proposal.factors[0]
    assert factor @ factor.T == pytest.approx(INFLATION * closed.covariance, rel=0.05)
    wide = find_modes(rival, step=STEP, seed=0, search=ROUGH).proposal.factors[0]
    ratio = (wide @ wide.T) / (modes.proposal.factors[0] @ modes.proposal.factors[0].T)
    assert ratio == pytest.approx(ROUGH.widened, rel=0.05)


def test_starts_near_a_mode_lead_to_it_as_well():
    rival = linear_rival()
    modes = find_modes(rival, step=STEP, seed=0)
    again = find_modes(rival, step=STEP, seed=5, near=modes.u + 0.01)
    assert again.u == pytest.approx(modes.u, abs=1e-2)


def test_a_local_proposal_is_as_narrow_as_the_data_say_wherever_it_is():
    rival = linear_rival()
    modes = find_modes(rival, step=STEP, seed=0)
    u = np.array([[0.0, 0.0], [1.0, -1.0]])
    local = local_proposal(rival, u, modes.whiten, STEP)
    assert (local.means == u).all()
    for factor in local.factors:
        assert factor == pytest.approx(modes.proposal.factors[0], rel=1e-3)


def test_along_a_ridge_points_stay_where_the_data_put_them():
    rival = linear_rival()
    modes = find_modes(rival, step=STEP, seed=0)
    rng = np.random.default_rng(0)
    proposal = along_ridges(rival, modes, step=STEP, rng=rng)
    target = rival.log_prior(proposal.means) + rival.log_likelihood(proposal.means)
    best = rival.log_prior(modes.u) + rival.log_likelihood(modes.u)
    assert len(proposal.means) > 1
    assert target.min() > best[0] - 20
    # Never wider than at the mode.
    assert (
        np.linalg.det(proposal.factors)
        <= np.linalg.det(modes.proposal.factors[0]) * (1 + 1e-6)
    ).all()


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

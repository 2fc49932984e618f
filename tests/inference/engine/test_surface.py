"""Surfaces of a likelihood, and draws that pass them."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import multivariate_normal

from sbi_active.inference.engine import infer, search
from sbi_active.inference.engine.pool import Pool, PriorDraws
from sbi_active.inference.engine.settings import SurfaceSettings
from sbi_active.inference.engine.surface import (
    Screened,
    Surface,
    SurfacePotential,
    fitted_surface,
)
from sbi_active.inference.sampling.least_squares import descend
from sbi_active.inference.sampling.mixtures import StudentMixture
from tests.inference.engine.test_engine import Given

X = np.array([0.5, -0.3, 0.8, 0.1, -0.6, 0.4])


def bent(sd=0.2, bend=0.7):
    """Six sums, each of a parameter and the square of the one before."""

    def residual(u):
        before = np.concatenate([np.zeros((len(u), 1)), u[:, :-1]], axis=1)
        return (X - u - bend * before**2) / sd

    return Given(residual, 6, 6, sd=sd)


def evidence_of_bent(sd, bend, num=400_000):
    """Return log Z: the sums are a shear of the parameters, of volume one."""
    sums = X + sd * np.random.default_rng(0).standard_normal((num, 6))
    u = np.zeros_like(sums)
    u[:, 0] = sums[:, 0]
    for k in range(1, 6):
        u[:, k] = sums[:, k] - bend * u[:, k - 1] ** 2
    log_prior = -0.5 * (u**2).sum(1) - 3 * np.log(2 * np.pi)
    return float(logsumexp(log_prior) - np.log(num))


def test_a_polynomial_response_is_predicted_where_no_draw_was():
    own, rng = bent(), np.random.default_rng(0)
    pool = Pool.empty(6)
    u = X + 0.5 * rng.standard_normal((500, 6))
    pool.add(PriorDraws(own), u, own)
    settings = SurfaceSettings(depth=np.inf)
    surface = fitted_surface(own, lambda r: r, pool, rng, settings)
    assert surface is not None
    assert surface.degree == 2
    assert surface.efficiency == pytest.approx(1.0, abs=1e-6)
    far = 2 * rng.standard_normal((50, 6))
    assert surface.log_likelihood(far) == pytest.approx(own.log_likelihood(far))


def test_few_draws_have_no_surface():
    own, rng = bent(), np.random.default_rng(0)
    pool = Pool.empty(6)
    pool.add(PriorDraws(own), X + 0.1 * rng.standard_normal((10, 6)), own)
    assert fitted_surface(own, lambda r: r, pool, rng, SurfaceSettings()) is None


@pytest.mark.parametrize("shift", [0.0, 1.0, 30.0])
def test_weights_are_right_whatever_the_surface(shift):
    """The surface's posterior is off by none, one and thirty deviations."""
    dim, sd, rng = 3, 0.5, np.random.default_rng(3)
    target = multivariate_normal(np.zeros(dim), sd**2 * np.eye(dim))
    normal = multivariate_normal(np.zeros(dim), np.eye(dim))
    prior = SimpleNamespace(dim=dim, log_prior=normal.logpdf)
    off = np.concatenate([np.full((dim, 1), -shift), np.eye(dim) / sd], axis=1)
    surface = Surface(np.zeros(dim), np.eye(dim), 1, off, 0.0, 1.0)
    base = StudentMixture(np.zeros((1, dim)), np.eye(dim)[None])
    own = SurfaceSettings()
    passed = Screened(base, SurfacePotential(prior, surface)).leveled(rng, own)
    u = passed.sample(20_000, rng)
    weight = np.exp(target.logpdf(u) - passed.log_prob(u))
    error = np.hypot(weight.std() / len(u) ** 0.5, passed.error)
    assert weight.mean() == pytest.approx(1.0, abs=4 * error)
    assert error < 0.05
    mean = (weight[:, None] * u).sum(0) / weight.sum()
    assert np.abs(mean).max() < 0.05


def test_most_draws_of_a_bent_posterior_count():
    own, rng = bent(0.1, 2.0), np.random.default_rng(1)
    found = infer(own, rng, found=search(own, rng))
    assert isinstance(found.final, Screened)
    exact = evidence_of_bent(0.1, 2.0)
    assert 0 < found.final.error < found.standard_error
    error = 4 * found.standard_error + 0.01  # of the reference's own draws
    assert found.log_evidence == pytest.approx(exact, abs=error)
    assert found.effective_sample_size > 0.5 * found.num_drawn
    assert found.tail_shape < 0.7


def test_a_search_ends_at_the_bottom_of_a_bent_valley():
    own = bent(sd=0.01)
    start = np.full((1, 6), 2.0)
    end, cost = descend(own, start, lambda r: r, 3e-3, 30)
    assert (own.residual(end)[0] ** 2).sum() + (end**2).sum() == pytest.approx(cost[0])
    again, _ = descend(own, end, lambda r: r, 3e-3, 30)
    assert again == pytest.approx(end, abs=1e-3)

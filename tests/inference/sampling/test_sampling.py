"""What beliefs are drawn and fitted with, against SciPy, torch and closed forms."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch
from scipy.optimize import nnls
from scipy.stats import multivariate_normal, multivariate_t, norm, truncnorm

from sbi_active.inference.networks.mixture_density import Adam
from sbi_active.inference.sampling import mixtures
from sbi_active.inference.sampling.gaussian_process import GaussianProcess
from sbi_active.inference.sampling.least_squares import within
from sbi_active.inference.sampling.smc import bridge
from sbi_active.inference.sampling.weights import systematic


def test_it_is_that_of_torch_to_the_last_bit():
    ours = torch.nn.Sequential(torch.nn.Linear(5, 3), torch.nn.Linear(4, 2))
    theirs = copy.deepcopy(ours)
    known = torch.optim.Adam(theirs.parameters(), lr=0.01, fused=True)
    steps = Adam(ours.parameters(), rate=0.01)
    for _ in range(20):
        x = torch.randn(7, 5)
        for made, optimizer in ((ours, steps), (theirs, known)):
            for parameter in made.parameters():
                parameter.grad = None
            made[0](x).square().mean().backward()  # the second layer has no gradient
            optimizer.step()
    for one, two in zip(ours.parameters(), theirs.parameters(), strict=True):
        assert torch.equal(one, two)


# Eigenvalues where divide and conquer does not converge


def symmetric(*shape):
    a = np.random.default_rng(0).standard_normal(shape)
    return a + np.swapaxes(a, -1, -2)


@pytest.fixture
def never_converges(monkeypatch):
    def fails(matrix):
        raise np.linalg.LinAlgError("Eigenvalues did not converge")

    monkeypatch.setattr(np.linalg, "eigh", fails)


@pytest.mark.parametrize("shape", [(6, 6), (2, 3, 6, 6)])
def test_robust_representations_take_over(never_converges, shape):
    a = symmetric(*shape)
    values, vectors = mixtures.eigh(a)
    assert values.shape == shape[:-1]
    assert (np.diff(values) >= 0).all()
    again = (vectors * values[..., None, :]) @ np.swapaxes(vectors, -1, -2)
    assert np.allclose(again, a, rtol=0, atol=1e-12)


# Gaussian mixtures fitted to points


def test_no_component_lies_across_two_thin_modes():
    # From one set of seeds 8.5 nats of each of these were missed.
    exact = -np.log(2 * np.pi) - np.log(2e-4) - 1
    for seed in (79, 357, 521):
        rng = np.random.default_rng(seed)
        mode, apart = (
            np.where(np.arange(1_000) % 2, 1.0, -1.0),
            rng.normal(size=(1_000, 2)),
        )
        points = np.stack([mode + 1e-4 * apart[:, 0], apart[:, 1]], 1)
        assert (
            mixtures.fitted_normals(points, 4, rng).log_prob(points).mean()
            > exact - 0.2
        )


# Gaussian processes on few simulations


def test_a_trend_of_ten_thousand_deviations_is_known_to_one():
    rng = np.random.default_rng(0)
    slope = np.array([[1.5e4, -3.0], [5.0, 2.0]])
    u, new = rng.uniform(-1, 1, (20, 2)), rng.uniform(-1, 1, (50, 2))

    def f(u):
        return (u @ slope + [7.0, 1.0] + np.sin(3 * u)).astype(np.float32)

    process = GaussianProcess.fit(u, f(u).astype(float), noise="none")
    mean, variance = process.predict(new)
    assert np.abs(mean - f(new)).max() < 0.5
    assert np.sqrt(variance).max() < 0.7
    assert np.abs(process.left_out).max() < 0.5


# Least squares within bounds, against SciPy's


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


# Student-t mixtures against SciPy's density and closed-form moments


MEANS = np.array([[-3.0, 0.0], [3.0, 1.0]])
FACTORS = np.array([[[1.0, 0.0], [0.8, 0.5]], [[0.3, 0.0], [-0.1, 0.2]]])
WEIGHTS = np.array([0.25, 0.75])
Z = np.random.default_rng(0).normal(size=(2_500, 2)) * 3


def density(weights: np.ndarray) -> np.ndarray:
    """Return SciPy's density at Z."""
    parts = zip(weights, MEANS, FACTORS, strict=True)
    return sum(w * multivariate_t(m, f @ f.T, df=5).pdf(Z) for w, m, f in parts)


def test_the_density_is_scipy_s():
    mixture = mixtures.StudentMixture(MEANS, FACTORS, WEIGHTS)
    assert mixture.log_prob(Z) == pytest.approx(np.log(density(WEIGHTS)))
    even = mixtures.StudentMixture(MEANS, FACTORS)
    assert even.log_prob(Z) == pytest.approx(np.log(density(np.full(2, 0.5))))


def test_a_split_mixture_is_normalized_and_matches_its_draws():
    rng = np.random.default_rng(0)
    axes = FACTORS @ np.array([[0.8, -0.6], [0.6, 0.8]])
    left, right = np.array([[1.0, 1.0], [2.0, 1.0]]), np.array([[3.0, 1.0], [1.0, 0.5]])
    split = mixtures.StudentMixture(MEANS, axes, WEIGHTS, 7.0, left, right)
    wide = mixtures.StudentMixture(MEANS, 4 * FACTORS, WEIGHTS)
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
    factor = mixtures.lower_factors(covariance)
    assert (np.triu(factor, 1) == 0).all()
    assert (np.diagonal(factor, axis1=1, axis2=2) > 1e-7).all()
    product = factor @ np.swapaxes(factor, 1, 2)
    assert product[0] == pytest.approx(covariance[0], abs=1e-9)


# Evidences and moments of densities whose integral is known


def standard(u):
    return norm.logpdf(u).sum(1)


def mixture(*means, sd=1.0):
    means = np.array(means, dtype=float)
    factors = np.stack([sd * np.eye(means.shape[1])] * len(means))
    return mixtures.StudentMixture(means, factors, freedom=np.inf)


def test_two_modes_keep_their_masses():
    def likelihood(u):
        parts = [multivariate_normal.logpdf(u, [m, 0], 0.04) for m in (-2, 1)]
        return np.logaddexp(*parts)

    base, rng = mixture([-2, 0], [1, 0], sd=0.3), np.random.default_rng(0)
    found = bridge(standard, likelihood, base, rng, num_particles=4_000)
    masses = multivariate_normal.pdf([[-2, 0], [1, 0]], [0, 0], 1.04 * np.eye(2))
    assert abs(found.log_evidence - np.log(sum(masses))) < 4 * found.standard_error
    share = (found.u[:, 0] < -0.5).mean()
    assert share == pytest.approx(masses[0] / sum(masses), abs=0.05)


def test_too_few_evaluations_are_no_answer():
    def likelihood(u):
        return norm.logpdf(1.0, u, 0.01).sum(1)

    base, rng = mixture([-3.0], sd=0.1), np.random.default_rng(0)
    assert bridge(standard, likelihood, base, rng, num_particles=500, most=600) is None


# Normal variables between bounds, in the tails too, against SciPy


LOW = np.array([-1.0, 3.0, -np.inf, -9.0, -np.inf])
HIGH = np.array([2.0, 8.0, -6.0, np.inf, np.inf])


def test_probability_between_bounds():
    one = np.ones(5)
    expected = np.log(norm.sf((LOW - 1) / 2) - norm.sf((HIGH - 1) / 2))
    assert mixtures.log_inside(one, 2 * one, LOW, HIGH) == pytest.approx(expected)
    far = mixtures.log_inside(one[:1], one[:1], np.array([31.0]), np.array([41.0]))
    assert far[0] == pytest.approx(norm.logsf(30.0))


def test_draws_between_bounds():
    rng = np.random.default_rng(0)
    for low, high in zip(LOW, HIGH, strict=True):
        ends = np.full(4_000, low), np.full(4_000, high)
        draws = mixtures.truncated_normal(
            np.ones(4_000), np.full(4_000, 2.0), *ends, rng
        )
        own = truncnorm((low - 1) / 2, (high - 1) / 2, 1, 2)
        assert (low <= draws).all()
        assert (draws <= high).all()
        assert draws.mean() == pytest.approx(own.mean(), abs=4 * own.std() / 60)


# Weights, how many of them count, and resampling, against closed forms


@pytest.mark.parametrize("offset", [0.0, 0.3, 0.5, np.nextafter(1, 0)])
def test_systematic_resampling_rounds_the_expected_number_up_or_down(offset):
    weight = np.random.default_rng(0).dirichlet(np.ones(20))
    index = systematic(weight, 1_000, offset)
    count = np.bincount(index, minlength=20)
    assert len(index) == 1_000
    assert (np.diff(index) >= 0).all()
    assert (abs(count - 1_000 * weight) < 1).all()


def test_rounding_of_the_last_weight_leaves_the_indices_in_range():
    weight = np.full(10, 0.1) * (1 - 1e-12)
    assert systematic(weight, 5, np.nextafter(1, 0)).max() == 9

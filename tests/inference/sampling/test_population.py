"""Population Monte Carlo on densities with known normalizers."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import logsumexp

from sbi_active.inference.sampling import (
    GaussianMixture,
    Particles,
    StudentProposal,
    Unbounding,
    population_monte_carlo,
)


class Box:
    """Uniform on [-1, 1]^2."""

    def sample(self, num_samples: int, rng: np.random.Generator) -> np.ndarray:
        return rng.uniform(-1, 1, (num_samples, 2))

    def log_prob(self, z: np.ndarray) -> np.ndarray:
        return np.where((abs(z) <= 1).all(1), -np.log(4), -np.inf)


def peaks(centers: np.ndarray, sd: np.ndarray):
    """Return a log density, zero outside the box, of integral len(centers)."""

    def log_density(z: np.ndarray) -> np.ndarray:
        square = (((z[:, None] - centers) / sd) ** 2).sum(-1)
        log_peak = -0.5 * square - np.log(2 * np.pi * sd.prod())
        total = np.asarray(logsumexp(log_peak, axis=1))
        return np.where((abs(z) <= 1).all(1), total, -np.inf)

    return log_density


@pytest.mark.parametrize(
    ("centers", "sd"),
    [
        ([[0.2, -0.3]], [1e-4, 1e-4]),
        ([[0.3, 0.0]], [1e-4, 0.2]),
        ([[-0.7, 0.2], [0.7, -0.2]], [1e-3, 1e-2]),
        ([[-0.8, 0.2], [-0.3, 0.2], [0.2, 0.2], [0.7, 0.2]], [0.01, 0.1]),
    ],
)
def test_finds_narrow_peaks(centers: list, sd: list):
    rng = np.random.default_rng(0)
    place, width = np.array(centers), np.array(sd)
    particles, num_steps = population_monte_carlo(
        peaks(place, width), Box(), rng, num_particles=8_000
    )
    error = 1 / np.sqrt(particles.effective_sample_size)
    assert particles.effective_sample_size > 800
    assert abs(particles.log_normalizer - np.log(len(place))) < 4 * error
    points = particles.resample(4_000, rng)
    nearest = ((points[:, None] - place) ** 2).sum(-1).argmin(1)
    share = np.bincount(nearest, minlength=len(place)) / 4_000
    assert abs(share - 1 / len(place)).max() < 4 * error
    assert num_steps < 40


@pytest.mark.parametrize("far_peak", [True, False])
def test_the_share_of_the_base_finds_a_peak_that_the_mixture_lost(far_peak: bool):
    rng = np.random.default_rng(0)
    centers = np.array([[-0.5, 0.0], [0.5, 0.0]])
    # The mixture knows the first peak only; its tails do not reach the other.
    points = centers[0] + 0.1 * rng.standard_normal((500, 2))
    proposal = StudentProposal(GaussianMixture.fit(points, 1, rng), Box())
    log_density = peaks(centers[: 1 + far_peak], np.array([0.1, 0.1]))
    z = proposal.sample(40_000, rng)
    particles = Particles(z, log_density(z) - proposal.log_prob(z), proposal)
    weight = np.exp(particles.log_weight)
    far = z[:, 0] > 0
    error = (weight * far).std() / 200
    assert error < 0.1
    assert (weight * far).mean() == pytest.approx(1.0 * far_peak, abs=4 * error + 1e-3)
    assert (weight * ~far).mean() == pytest.approx(1, abs=0.03)
    # Few draws carry the far peak's half: the effective sample size shows it.
    share = particles.effective_sample_size / len(z)
    assert share < 0.05 if far_peak else share > 0.5


def test_proposal_density_is_normalized_and_matches_its_draws():
    rng = np.random.default_rng(0)
    points = np.concatenate(
        [0.1 * rng.standard_normal((400, 2)) + c for c in ([-0.5, 0], [0.5, 0.3])]
    )
    proposal = StudentProposal(GaussianMixture.fit(points, 2, rng), Box())
    box = Box().sample(100_000, rng)
    density = 4 * np.exp(proposal.log_prob(box))
    inside = (abs(proposal.sample(20_000, rng)) <= 1).all(1).mean()
    error = density.std() / np.sqrt(len(box)) + 0.5 / np.sqrt(20_000)
    assert abs(density.mean() - inside) < 4 * error


def test_unbounded_proposal_is_normalized_and_stays_within_edges():
    rng = np.random.default_rng(0)
    line = Unbounding(np.array([True, True]))
    points = 1 - 0.3 * rng.random((800, 2)) ** 2  # piled up at a corner
    proposal = StudentProposal.fit(points, 2, Box(), rng, line)
    z = line.from_line(line.to_line(points))
    assert abs(z - points).max() < 1e-9
    box = rng.uniform(-1, 1, (100_000, 2))
    density = 4 * np.exp(proposal.log_prob(box))
    assert density.mean() == pytest.approx(1, abs=4 * density.std() / 100_000**0.5)
    assert (abs(proposal.sample(10_000, rng)) <= 1).all()


@pytest.mark.parametrize("dim", [9, 12])
def test_a_density_cut_at_many_edges(dim: int):
    # A normal density about a corner of the box, 1 in 2^d of which is within.
    class Cube:
        def sample(self, num_samples: int, rng: np.random.Generator) -> np.ndarray:
            return rng.uniform(-1, 1, (num_samples, dim))

        def log_prob(self, z: np.ndarray) -> np.ndarray:
            return np.where((abs(z) <= 1).all(1), -dim * np.log(2), -np.inf)

    def log_density(z: np.ndarray) -> np.ndarray:
        log_prob = -0.5 * (((z - 1) / 0.2) ** 2).sum(1) - dim * np.log(0.2)
        log_prob = log_prob - 0.5 * dim * np.log(np.pi / 2)
        return np.where((abs(z) <= 1).all(1), log_prob, -np.inf)

    particles, _ = population_monte_carlo(
        log_density,
        Cube(),
        np.random.default_rng(0),
        num_particles=1_300 * dim,
        num_components=3,
        unbounding=Unbounding(np.ones(dim, dtype=bool)),
    )
    assert particles.effective_sample_size > 500
    assert abs(particles.log_normalizer) < 4 / particles.effective_sample_size**0.5


def test_mixture_handles_repeated_points():
    rng = np.random.default_rng(0)
    points = np.repeat(rng.standard_normal((3, 2)), 100, axis=0)
    mixture = GaussianMixture.fit(points, 6, rng)
    assert np.isfinite(mixture.factor).all()
    assert len(np.unique(mixture.assign(points))) <= 3

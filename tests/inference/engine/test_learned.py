"""The posterior of a learned likelihood, on densities with known normalizers."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from sbi.utils import BoxUniform
from scipy.special import logsumexp

from sbi_active.inference.engine.importance import pareto_shape
from sbi_active.inference.engine.learned import learned_fit
from sbi_active.inference.sampling.coordinates import PriorCoordinates


def likelihood_of(dim: int, log_likelihood: Any) -> Any:
    """Return a likelihood over a box prior between -1 and 1."""
    prior = BoxUniform(-torch.ones(dim), torch.ones(dim))
    coordinates = PriorCoordinates(prior, np.random.default_rng(0))
    return SimpleNamespace(coordinates=coordinates, log_likelihood=log_likelihood)


def peaks(centers: np.ndarray, sd: np.ndarray) -> Any:
    """Return a log density of integral len(centers) in the plane."""

    def log_density(z: np.ndarray) -> np.ndarray:
        square = (((z[:, None] - centers) / sd) ** 2).sum(-1)
        log_peak = -0.5 * square - np.log(2 * np.pi * sd.prod())
        return np.asarray(logsumexp(log_peak, axis=1))

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
    found = learned_fit(likelihood_of(2, peaks(place, width)), rng)
    effective = found.effective_sample_size
    assert effective > 2_900
    assert found.efficiency > 0.2
    error = 1 / effective**0.5
    exact = np.log(len(place)) - 2 * np.log(2)
    assert found.log_evidence == pytest.approx(exact, abs=4 * error)
    draws = found.draws(4_000, rng)
    nearest = ((draws[:, None] - place) ** 2).sum(-1).argmin(1)
    share = np.bincount(nearest, minlength=len(place)) / 4_000
    assert abs(share - 1 / len(place)).max() < 4 * error


@pytest.mark.parametrize("dim", [12])
def test_a_density_cut_at_many_edges(dim: int):
    # A normal density about a corner of the box, 1 in 2^d of which is within.
    def log_density(z: np.ndarray) -> np.ndarray:
        log_prob = -0.5 * (((z - 1) / 0.2) ** 2).sum(1) - dim * np.log(0.2)
        return log_prob - 0.5 * dim * np.log(np.pi / 2)

    own = likelihood_of(dim, log_density)
    found = learned_fit(own, np.random.default_rng(0), num_effective=1_000)
    assert found is not None
    effective = found.effective_sample_size
    assert effective > 990
    exact = -dim * np.log(2)
    assert found.log_evidence == pytest.approx(exact, abs=4 / effective**0.5)


PLATEAU = -20.0  # log likelihood where nothing is known
DIM = 4


# A needle that nothing points at is for no sampler.
@pytest.mark.parametrize(
    ("is_known", "width"), [(True, 0.003), (True, 0.05), (False, 0.05)]
)
def test_a_peak_on_a_plateau_is_not_lost(is_known: bool, width: float):
    rng, center = np.random.default_rng(0), np.array([0.5, -0.2, 0.1, 0.6])

    def log_likelihood(z: np.ndarray) -> np.ndarray:
        square = ((z - center) ** 2).sum(1) / (2 * width**2)
        peak = -square - DIM * np.log(width * np.sqrt(2 * np.pi))
        return np.logaddexp(peak, PLATEAU)

    known = center + 5 * width * rng.standard_normal((400, DIM))
    own = likelihood_of(DIM, log_likelihood)
    near = known if is_known else own.coordinates.sample_prior(400, rng)
    found = learned_fit(own, rng, near=near)
    assert found.log_evidence == pytest.approx(-DIM * np.log(2), abs=0.1)
    draws = found.draws(500, rng)
    assert draws.mean(0) == pytest.approx(center, abs=0.3 * width)


@pytest.mark.parametrize("shape", [0.5, 1.0])
def test_pareto_shape_is_that_of_arviz(shape: float):
    arviz = pytest.importorskip("arviz")
    rng = np.random.default_rng(int(10 * shape))
    log_weight = np.log(rng.pareto(1 / shape, 4_000) + 1)
    other = float(arviz.psislw(log_weight)[1])
    assert pareto_shape(log_weight) == pytest.approx(other, abs=0.02)
    assert pareto_shape(log_weight) == pytest.approx(shape, abs=0.25)

"""Regions and coordinates."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from sbi.utils import BoxUniform, MultipleIndependent
from scipy.stats import chi
from torch.distributions import (
    Gamma,
    Independent,
    LogNormal,
    MultivariateNormal,
    Uniform,
)

from sbi_active.inference.regression.regions import (
    SPREAD,
    Region,
    cover,
    nearest_region,
)
from sbi_active.inference.sampling.coordinates import PriorCoordinates

PRIORS = {
    "box": BoxUniform(torch.tensor([-5.0, 0.0]), torch.tensor([5.0, 1e-3])),
    "gaussian": MultivariateNormal(torch.tensor([1.0, 100.0]), 4 * torch.eye(2)),
    "log_normal": Independent(LogNormal(torch.tensor([0.0, -5.0]), 1.0), 1),
    "mixed": MultipleIndependent(
        [Gamma(torch.ones(1), 1.0), Uniform(torch.zeros(1), torch.ones(1))]
    ),
}


@pytest.mark.parametrize("name", PRIORS)
def test_coordinates_go_there_and_back(name: str):
    rng = np.random.default_rng(0)
    coordinates = PriorCoordinates(PRIORS[name], rng)
    torch.manual_seed(0)
    theta = PRIORS[name].sample((1_000,))
    z = coordinates.to_z(theta)
    torch.testing.assert_close(coordinates.to_theta(z), theta, rtol=1e-5, atol=1e-7)
    # Of unit size: a box is [-1, 1], anything else has 2.5 deviations in it.
    assert (abs(z) < 1.2).mean() > 0.95
    assert coordinates.inside(z).mean() > 0.99  # but for rounding at the edge


@pytest.mark.parametrize("name", PRIORS)
def test_prior_is_normalized_in_coordinates(name: str):
    coordinates = PriorCoordinates(PRIORS[name], np.random.default_rng(0))
    axis = np.linspace(-4, 4, 801) + 1e-4
    grid = np.stack(np.meshgrid(axis, axis), -1).reshape(-1, 2)
    total = np.exp(coordinates.log_prior(grid)).sum() * (axis[1] - axis[0]) ** 2
    assert total == pytest.approx(1, abs=0.02)  # rim of a box: one cell in 200


def test_simulations_stay_in_region_and_support():
    rng = np.random.default_rng(0)
    coordinates = PriorCoordinates(PRIORS["box"], rng)
    region = Region(np.array([1.0, 0.0]), 0.3 * np.eye(2), 1.0)  # half is outside
    z = region.sample_inside(200, coordinates, rng)
    assert len(z) == 200
    assert region.distance(z).max() <= 1
    assert coordinates.inside(z).all()


@pytest.mark.parametrize("num_modes", [1, 4])
def test_cover_holds_each_mode(num_modes: int):
    rng = np.random.default_rng(0)
    centers = np.linspace(-0.9, 0.9, num_modes) if num_modes > 1 else np.zeros(1)
    label = rng.integers(num_modes, size=5_000)
    z = 0.01 * rng.standard_normal((5_000, 2))
    z[:, 0] += centers[label]
    regions = cover(z[:1_000], rng, max_regions=8, generous=True)
    assert len(regions) >= num_modes
    assert (nearest_region(regions, z) >= 0).mean() > 0.999
    # Between the modes lies nothing: the ellipsoids are much smaller than the box.
    areas = [r.radius**2 * abs(np.linalg.det(r.factor)) for r in regions]
    assert math.pi * sum(areas) < 0.1


@pytest.mark.parametrize("dim", [1, 6, 20])
def test_simulations_fill_a_region_of_any_dimension(dim: int):
    rng = np.random.default_rng(0)
    prior = MultivariateNormal(torch.zeros(dim), torch.eye(dim))
    coordinates = PriorCoordinates(prior, rng)
    region = Region(np.full(dim, 0.1), 0.2 * np.eye(dim), 3.0)
    z = region.sample_inside(2_000, coordinates, rng)
    assert len(z) == 2_000
    # Normal numbers of deviation R / 2.2 on each axis, where the length is below R.
    kept = chi.cdf(SPREAD, dim + 2) / chi.cdf(SPREAD, dim)
    expected = 0.2 * 3.0 / SPREAD * kept**0.5
    assert region.distance(z).max() <= 1
    assert z.std() == pytest.approx(expected, rel=4 * (2 * 2_000 * dim) ** -0.5 + 0.01)


def test_simulations_fill_what_a_box_of_many_sides_leaves_of_a_region():
    rng = np.random.default_rng(0)
    dim = 20
    coordinates = PriorCoordinates(BoxUniform(-torch.ones(dim), torch.ones(dim)), rng)
    region = Region(np.full(dim, 0.3), np.eye(dim), 7.0)  # one draw in 1e6 is inside
    z = region.sample_inside(500, coordinates, rng)
    assert len(z) == 500
    assert region.distance(z).max() <= 1
    assert coordinates.inside(z).all()
    assert z.std(0).min() > 0.3  # a uniform draw has .58 on each axis

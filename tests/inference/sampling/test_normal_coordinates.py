"""Coordinates in which a prior has no mean and unit variance."""

import numpy as np
import pytest
import torch
from sbi.utils import BoxUniform, MultipleIndependent
from torch.distributions import Independent, LogNormal, Normal

from sbi_active.inference.sampling.coordinates import (
    NormalCoordinates,
    PriorCoordinates,
)

BOX = BoxUniform(torch.tensor([1.0, -2.0]), torch.tensor([3.0, 8.0]))


def coordinates(prior, **options):
    rng = np.random.default_rng(0)
    return NormalCoordinates(PriorCoordinates(prior, rng), rng, **options)


def test_a_box_keeps_its_edges_and_what_is_straight_stays_so():
    c = coordinates(BOX)
    assert c.high == pytest.approx(3**0.5, abs=1e-4)
    assert c.low == pytest.approx(-(3**0.5), abs=1e-4)
    assert (c.precision == 0).all()
    theta = c.to_theta(np.linspace(c.low, c.high, 5)).numpy()
    assert np.diff(theta, 2, axis=0) == pytest.approx(0, abs=1e-5)
    assert theta[0] == pytest.approx([1.0, -2.0], abs=1e-4)
    inside = np.array([[0.0, 0.0], [1.7, -1.7]])
    assert c.log_prior(inside) == pytest.approx(-np.log(12), abs=1e-6)
    assert np.isneginf(c.log_prior(np.array([[1.8, 0.0]]))).all()


def test_on_request_a_uniform_number_is_normal():
    c = coordinates(BOX, keeps_edges=False)
    u = np.array([[0.5, -1.0], [3.0, 0.0]])
    normal = -0.5 * (u**2).sum(1) - np.log(2 * np.pi)
    assert c.log_prior(u) == pytest.approx(normal, abs=0.3)
    assert (c.precision == 1).all()


@pytest.mark.parametrize("options", [{}, {"keeps_edges": False}])
def test_draws_have_unit_variance_and_go_to_parameters_and_back(options):
    prior = MultipleIndependent(
        [
            BoxUniform(torch.zeros(1), torch.ones(1)),
            Independent(LogNormal(torch.zeros(1), torch.ones(1)), 1),
            Independent(Normal(torch.zeros(1), 3 * torch.ones(1)), 1),
        ],
        validate_args=False,
    )
    c = coordinates(prior, **options)
    u = c.sample(4_000, np.random.default_rng(1))
    assert u.mean(0) == pytest.approx(0, abs=0.1)
    assert u.std(0) == pytest.approx(1, abs=0.1)
    again = c.from_z(c.base.to_z(c.to_theta(u)))
    assert again == pytest.approx(u, abs=1e-3)

"""Coordinates of a search: densities against closed forms, and what is where."""

import numpy as np
import pytest
import torch
from sbi.utils import BoxUniform
from torch.distributions import Independent, LogNormal, Normal

from sbi_active.criticism.rivals.coordinates import SearchCoordinates
from tests.effects import effect, half, normal

BOX = BoxUniform(torch.tensor([1.0]), torch.tensor([3.0]))
WIDE_ONE = effect("wide", prior=LogNormal(torch.zeros(1), 2 * torch.ones(1)))
START = effect("start", prior=Normal(torch.zeros(2), torch.ones(2)), scope="trial")


def coordinates(num_trials=3):
    return SearchCoordinates(BOX, [WIDE_ONE], [START], num_trials)


def test_the_density_is_the_prior_s_times_the_jacobian():
    c = coordinates()
    u = c.sample(50, seed=3)
    z = torch.from_numpy(c.to_z(u))
    expected = -np.log(2.0) + LogNormal(0.0, 2.0).log_prob(z[:, 1])
    expected = expected + Independent(Normal(torch.zeros(6), 1.0), 1).log_prob(z[:, 2:])
    # dz / du is b, and b z where z is searched in logs.
    expected = expected + np.log(c.scale).sum() + z[:, 1].log()
    assert c.log_prob(u) == pytest.approx(expected.numpy(), abs=1e-5)


def test_bounds_stay_bounds_and_count_as_within():
    c = coordinates()
    assert c.low[1:] == pytest.approx(-np.inf)
    u = np.zeros((4, c.dim))
    u[:, 0] = [c.low[0], c.high[0], c.low[0] - 1e-6, c.high[0] + 1e-6]
    assert np.isfinite(c.log_prob(u)).tolist()[2:] == [False, False]
    assert c.to_z(u)[:2, 0] == pytest.approx([1.0, 3.0])
    assert c.from_z(c.to_z(u)) == pytest.approx(u)


def test_a_coordinate_is_at_the_bound_where_its_draws_pile_up():
    c, rng = coordinates(), np.random.default_rng(0)
    for z, side in (
        (1.0 + 0.02 * rng.random((200, 1)), -1),
        (3.0 - 0.02 * rng.random((200, 1)), 1),
        (2.0 + 0.02 * rng.normal(size=(200, 1)), 0),
        (1.01 + 1e-3 * rng.normal(size=(200, 1)), 0),  # ten deviations from it
        (1.0 + 2.0 * rng.random((200, 1)), 0),  # the trials leave it open
    ):
        whole = np.concatenate([z, np.ones((200, c.dim - 1))], 1)
        assert c.sides(c.from_z(whole)[:, :1]).tolist() == [side]
        # Beside it are numbers without a bound, or with one.
        assert c.sides(c.from_z(whole))[1:].tolist() == [0] * (c.dim - 1)


# Coordinates carried from one rival to another mean the same there


FRICTION = effect("friction", prior=half(45.0))
OTHERS = [effect(f"other {k}") for k in range(3)]


def test_an_effect_and_a_nuisance_have_the_same_units_in_every_rival():
    prior = BoxUniform(torch.zeros(2), torch.tensor([1.0, 3.0]))
    alone = SearchCoordinates(prior, [FRICTION], [], 5)
    null = alone.from_z(np.array([[0.5, 1.0, 0.0]]))[0]
    for place, effects in ((5, [*OTHERS, FRICTION]), (2, [FRICTION, *OTHERS])):
        other = SearchCoordinates(prior, effects, [], 5)
        u = other.from_z(np.zeros((1, 6)))
        assert u[0, place] == other.low[place] == alone.low[2] == null[2]
        u[0, :2] = null[:2]
        np.testing.assert_allclose(other.to_z(u)[0, :2], [0.5, 1.0])
    offset = effect("offset", prior=normal(3.0))
    alone, beside = (SearchCoordinates(prior, e, [offset], 4) for e in ([], [FRICTION]))
    np.testing.assert_array_equal(alone.shift[2:], beside.shift[3:])
    np.testing.assert_array_equal(alone.scale[2:], beside.scale[3:])

"""Coordinates carried from one rival to another mean the same there."""

import numpy as np
import torch
from sbi.utils import BoxUniform
from torch.distributions import HalfNormal, Independent

from sbi_active.criticism.rivals.coordinates import SearchCoordinates
from tests.effects import effect, normal

PRIOR = BoxUniform(torch.zeros(2), torch.tensor([1.0, 3.0]))


WIDE = effect("friction", prior=Independent(HalfNormal(torch.tensor([45.0])), 1))
OTHERS = [effect(f"other {k}") for k in range(3)]


def test_an_effect_has_the_same_units_in_every_rival():
    alone = SearchCoordinates(PRIOR, [WIDE], [], 5)
    last = SearchCoordinates(PRIOR, [*OTHERS, WIDE], [], 5)
    first = SearchCoordinates(PRIOR, [WIDE, *OTHERS], [], 5)
    null = alone.from_z(np.array([[0.5, 1.0, 0.0]]))[0, 2]
    for place, other in ((5, last), (2, first)):
        u = other.from_z(np.zeros((1, 6)))
        assert u[0, place] == null
        assert other.low[place] == alone.low[2] == null
        u[0, :2] = alone.from_z(np.array([[0.5, 1.0, 0.0]]))[0, :2]
        np.testing.assert_allclose(other.to_z(u)[0, :2], [0.5, 1.0])


def test_so_do_nuisances_of_each_trial():
    offset = effect("offset", prior=normal(3.0))
    alone = SearchCoordinates(PRIOR, [], [offset], 4)
    beside = SearchCoordinates(PRIOR, [WIDE], [offset], 4)
    np.testing.assert_array_equal(alone.shift[2:], beside.shift[3:])
    np.testing.assert_array_equal(alone.scale[2:], beside.scale[3:])

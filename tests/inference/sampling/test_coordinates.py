"""Coordinates of a prior, against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from sbi.utils import BoxUniform
from torch.distributions import (
    Beta,
    Exponential,
    Independent,
    Normal,
    Uniform,
    constraints,
)

from sbi_active.support import support_bounds

ONES = torch.ones(2)


@pytest.mark.parametrize(
    ("prior", "low", "high"),
    [
        (BoxUniform(-ONES, torch.tensor([2.0, 3.0])), [-1, -1], [2, 3]),
        (Independent(Normal(0 * ONES, ONES), 1), [-np.inf] * 2, [np.inf] * 2),
        (Independent(Exponential(ONES), 1), [0, 0], [np.inf] * 2),
        (Independent(Beta(ONES, ONES), 1), [0, 0], [1, 1]),
        (Uniform(2.0, 5.0), [2, 2], [5, 5]),
    ],
)
def test_the_bounds_of_a_support(prior, low, high):
    found = support_bounds(prior.support, 2)
    assert found[0].tolist() == low
    assert found[1].tolist() == high


def test_the_bounds_of_joined_supports():
    joined = constraints.cat(
        [constraints.interval(-1.0, 1.0), constraints.positive], lengths=[2, 1]
    )
    low, high = support_bounds(constraints.independent(joined, 0), 3)
    assert low.tolist() == [-1, -1, 0]
    assert high.tolist() == [1, 1, np.inf]

"""Weights, how many of them count, and resampling, against closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from sbi_active.inference.sampling.weights import systematic


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

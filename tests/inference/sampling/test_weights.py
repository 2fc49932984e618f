"""Weights, how many of them count, and resampling, against closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from sbi_active.inference.sampling.weights import (
    effective_sample_size,
    normalized,
    systematic,
)


def test_the_effective_sample_size_is_kish_s():
    weight = np.array([1.0, 2.0, 3.0])
    assert effective_sample_size(np.log(weight)) == pytest.approx(36 / 14)
    shifted = effective_sample_size(np.log(weight) + 700)
    assert shifted == pytest.approx(36 / 14)


@pytest.mark.parametrize("log_weight", [[], [-np.inf] * 3, [np.nan, 0.0]])
def test_where_nothing_counts_no_draw_is_effective(log_weight):
    assert effective_sample_size(np.array(log_weight)) == 0


@pytest.mark.parametrize("shift", [0.0, -1e17, 1e17, 1e300])
def test_normalized_weights_sum_to_one(shift):
    weight = normalized(np.log(np.array([1.0, 3.0])) + shift)
    assert weight.sum() == pytest.approx(1)
    if abs(shift) < 1e16:  # beyond, log 3 is lost in the rounding of the sum
        assert weight == pytest.approx([0.25, 0.75])


def test_where_no_weight_is_finite_all_count_the_same():
    assert (normalized(np.full(4, -np.inf)) == 0.25).all()


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


def test_systematic_resampling_is_unbiased():
    weight = np.array([0.05, 0.6, 0.35])
    offsets = (np.arange(1_000) + 0.5) / 1_000
    count = sum(np.bincount(systematic(weight, 3, o), minlength=3) for o in offsets)
    assert count / 3_000 == pytest.approx(weight, abs=1e-3)

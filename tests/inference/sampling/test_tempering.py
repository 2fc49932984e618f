"""The largest power that suffices, against closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from sbi_active.inference.sampling.weights import effective_sample_size, largest_power


@pytest.mark.parametrize("answer", [0.73, 1e-3, 2.5e-8])
def test_the_largest_power_is_found_whatever_its_size(answer):
    assert largest_power(lambda b: b <= answer) == pytest.approx(answer, rel=1e-6)


def test_a_sequence_moves_on_where_nothing_suffices():
    assert largest_power(lambda _: False) == 1e-10
    assert largest_power(lambda _: False, start=0.5) == pytest.approx(0.5, abs=1e-9)
    assert largest_power(lambda _: False, start=0.5) > 0.5


def test_the_power_of_a_gaussian_leaves_the_share_that_its_moments_say():
    # Draws of N(0, 1) weighted by exp(-b c z^2 / 2): E[w]^2 / E[w^2] is
    # sqrt(1 + 2 b c) / (1 + b c).
    share, c = 0.5, 1e6
    z = np.random.default_rng(0).normal(size=200_000)
    power = largest_power(
        lambda b: effective_sample_size(-0.5 * b * c * z**2) >= share * len(z)
    )
    # (1 + s)^2 share^2 = 1 + 2 s for s = b c.
    s = (1 - share**2 + np.sqrt(1 - share**2)) / share**2
    assert power * c == pytest.approx(s, rel=0.03)

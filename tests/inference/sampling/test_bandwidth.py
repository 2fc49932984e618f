"""Widths of kernels against the figures in the literature and in SciPy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import gaussian_kde

from sbi_active.inference.sampling.weights import scott, silverman


@pytest.mark.parametrize("dim", [1, 3])
def test_the_rules_are_those_of_scipy(dim):
    kde = gaussian_kde(np.random.default_rng(0).normal(size=(dim, 50)))
    assert scott(50, dim) == pytest.approx(kde.scotts_factor())
    assert silverman(50, dim) == pytest.approx(kde.silverman_factor())

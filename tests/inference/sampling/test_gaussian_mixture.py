"""Gaussian mixtures fitted to points."""

from __future__ import annotations

import numpy as np

from sbi_active.inference.sampling.gaussian_mixture import GaussianMixture


def test_mixture_handles_repeated_points():
    rng = np.random.default_rng(0)
    points = np.repeat(rng.standard_normal((3, 2)), 100, axis=0)
    mixture = GaussianMixture.fit(points, 6, rng)
    assert np.isfinite(mixture.factor).all()
    assert len(np.unique(mixture.assign(points))) <= 3

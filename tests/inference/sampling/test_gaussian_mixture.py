"""Gaussian mixtures fitted to points."""

from __future__ import annotations

import numpy as np

from sbi_active.inference.sampling.mixtures import fitted_normals


def test_mixture_handles_repeated_points():
    rng = np.random.default_rng(0)
    points = np.repeat(rng.standard_normal((3, 2)), 100, axis=0)
    mixture = fitted_normals(points, 6, rng)
    assert np.isfinite(mixture.factors).all()
    assert len(np.unique(mixture.log_parts(points).argmax(0))) <= 3

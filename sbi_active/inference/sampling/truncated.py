"""Normal variables between bounds."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr, ndtr, ndtri

from sbi_active.arrays import Array


def log_inside(mean: Array, sd: Array, low: Array, high: Array) -> Array:
    """Return the log probability of a normal variable between bounds."""
    a, b = _lower_tail((low - mean) / sd, (high - mean) / sd)[:2]
    upper, lower = log_ndtr(b), log_ndtr(a)
    return upper + np.log1p(-np.exp(np.minimum(lower - upper, -1e-12)))


def truncated_normal(
    mean: Array, sd: Array, low: Array, high: Array, rng: np.random.Generator
) -> Array:
    """Return normal draws between bounds, all of shape (n,)."""
    a, b, flip = _lower_tail((low - mean) / sd, (high - mean) / sd)
    share = ndtr(a) + (ndtr(b) - ndtr(a)) * rng.random(len(mean))
    z = np.clip(ndtri(np.clip(share, 1e-300, 1 - 1e-16)), a, b)
    return mean + sd * np.where(flip, -z, z)


def _lower_tail(a: Array, b: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Return two quantiles mirrored to the lower tail, where small shares are exact."""
    with np.errstate(invalid="ignore"):
        flip = a + b > 0
    return np.where(flip, -b, a), np.where(flip, -a, b), flip

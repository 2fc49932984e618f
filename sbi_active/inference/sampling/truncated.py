"""Normal variables between bounds."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr, ndtr, ndtri

from sbi_active.arrays import Array
from sbi_active.inference.sampling.mixtures import lower_factors


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


def draws_between(
    mean: Array, cov: Array, low: Array, high: Array, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Return normal draws between bounds, (n, d), and their log weights, (n,).

    One coordinate is drawn after the other, those first that the bounds cut most. The
    weight is the probability that each is within its bounds given those before, over
    what it is were they independent.

    Args:
        mean: Mean of each draw, shape (n, d).
        cov: Covariance of each draw, shape (n, d, d).
        low: Lower bounds, shape (d,).
        high: Upper bounds, shape (d,).
        rng: Source of the draws.

    References:
        Hajivassiliou & McFadden, Econometrica 66 (1998), on the simulator of Geweke,
        Hajivassiliou and Keane.
    """
    sd = np.sqrt(np.einsum("nii->ni", cov))
    alone = log_inside(mean, sd, low, high)
    order = np.argsort(alone.sum(0), kind="stable")
    root = lower_factors(cov[:, order[:, None], order])
    z, u, log_weight = np.zeros_like(mean), np.empty_like(mean), -alone.sum(1)
    for i, j in enumerate(order):
        center = mean[:, j] + (root[:, i, :i] * z[:, :i]).sum(1)
        own = root[:, i, i]
        u[:, j] = truncated_normal(center, own, low[j], high[j], rng)
        log_weight += log_inside(center, own, low[j], high[j])
        z[:, i] = (u[:, j] - center) / own
    return u, log_weight


def _lower_tail(a: Array, b: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Return two quantiles mirrored to the lower tail, where small shares are exact."""
    with np.errstate(invalid="ignore"):
        flip = a + b > 0
    return np.where(flip, -b, a), np.where(flip, -a, b), flip

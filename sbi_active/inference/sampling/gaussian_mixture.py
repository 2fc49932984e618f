"""Mixtures of normal distributions, fitted by expectation-maximization."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sbi_active.inference.sampling.eigen import eigh
from sbi_active.inference.sampling.student_mixture import StudentMixture
from sbi_active.inference.sampling.weights import log_sum_exp

Array = NDArray[Any]


def fitted_normals(
    points: Array,
    num_components: int,
    rng: np.random.Generator,
    *,
    num_iterations: int = 25,
) -> StudentMixture:
    """Return normal components, fitted by expectation-maximization to points (n, d).

    They begin at seeds spread over the points. Repeated points count as often as they
    occur; where points are few, components are fewer.
    """
    center = points.mean(0)
    # A relative floor: a cluster may be 1e-5 of the cloud wide, or one point.
    spread = points.std(0) + 1e-12 * (np.abs(center) + 1.0)
    covariance = np.cov(((points - center) / spread).T, bias=True)
    root = np.linalg.cholesky(np.atleast_2d(covariance) + 1e-12 * np.eye(len(spread)))
    whitening = spread[:, None] * root
    z = np.linalg.solve(whitening, (points - center).T).T
    n, d = z.shape
    k = max(1, min(num_components, n // max(2 * d + 2, _num_moments(d))))
    share = _spread_responsibility(z, k, rng)
    previous = -np.inf
    for _ in range(num_iterations if k > 1 else 1):
        count = share.sum(0) + 1e-12
        mean = (share.T @ z) / count[:, None]
        second = (share.T[:, None] * z.T) @ z
        covariance = second / count[:, None, None] - mean[:, :, None] * mean[:, None]
        floor = 1e-9 + 1e-6 * (count < d + 1)[:, None, None]
        factor = np.linalg.cholesky(_positive(covariance) + floor * np.eye(d))
        mixture = StudentMixture(mean, factor, count / count.sum(), np.inf)
        joint = mixture.log_parts(z).T
        total = log_sum_exp(joint, axis=1)
        share = np.exp(joint - total[:, None])
        if total.mean() - previous < 1e-3:
            break
        previous = total.mean()
    return replace(
        mixture, means=mean @ whitening.T + center, factors=whitening @ factor
    )


def _num_moments(dim: int) -> int:
    """Return the numbers in a mean and a covariance."""
    return dim * (dim + 3) // 2


def _spread_responsibility(z: Array, k: int, rng: np.random.Generator) -> Array:
    """Return each point's nearest seed, the seeds far apart, shape (n, k)."""
    seeds = z[[rng.integers(len(z))]]
    square = ((z - seeds) ** 2).sum(1)
    for _ in range(k - 1):
        total = square.sum()
        pick = rng.choice(len(z), p=square / total) if total > 0 else 0
        seeds = np.concatenate([seeds, z[[pick]]])
        square = np.minimum(square, ((z - z[pick]) ** 2).sum(1))
    distance = ((z[:, None] - seeds) ** 2).sum(-1)
    return np.eye(k)[distance.argmin(1)]


def _positive(covariance: Array) -> Array:
    """Return the nearest positive semi-definite matrices; rounding leaves -1e-16."""
    value, vector = eigh(covariance)
    return (vector * np.maximum(value, 0.0)[:, None]) @ np.swapaxes(vector, -1, -2)

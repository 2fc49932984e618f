"""Gaussian mixtures, fitted by expectation-maximization."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sbi_active.inference.sampling.eigen import eigh
from sbi_active.inference.sampling.weights import log_sum_exp

Array = NDArray[Any]


@dataclass(frozen=True)
class GaussianMixture:
    """Gaussian mixture with full covariances.

    Attributes:
        log_weight: Log weights, shape (k,).
        mean: Means, shape (k, d).
        factor: Lower Cholesky factors, shape (k, d, d).
        log_likelihood: Mean log likelihood of the points it was fitted to.
    """

    log_weight: Array
    mean: Array
    factor: Array
    log_likelihood: float

    @staticmethod
    def fit(
        points: Array,
        num_components: int,
        rng: np.random.Generator,
        *,
        num_iterations: int = 25,
    ) -> GaussianMixture:
        """Fit by expectation-maximization from seeds spread over points (n, d).

        Repeated points count as often as they occur; where points are few, components
        are fewer.
        """
        center = points.mean(0)
        # A relative floor: a cluster may be 1e-5 of the cloud wide, or one point.
        spread = points.std(0) + 1e-12 * (np.abs(center) + 1.0)
        covariance = np.cov(((points - center) / spread).T, bias=True)
        root = np.linalg.cholesky(
            np.atleast_2d(covariance) + 1e-12 * np.eye(len(spread))
        )
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
            covariance = (
                second / count[:, None, None] - mean[:, :, None] * mean[:, None]
            )
            floor = 1e-9 + 1e-6 * (count < d + 1)[:, None, None]
            factor = np.linalg.cholesky(_positive(covariance) + floor * np.eye(d))
            log_weight = np.log(count / count.sum())
            joint = log_weight + _gaussian_log_prob(z, mean, factor)
            total = log_sum_exp(joint, axis=1)
            share = np.exp(joint - total[:, None])
            if total.mean() - previous < 1e-3:
                break
            previous = total.mean()
        log_volume = np.log(np.diag(whitening)).sum()
        return GaussianMixture(
            log_weight,
            mean @ whitening.T + center,
            whitening @ factor,
            float(total.mean() - log_volume),
        )

    def log_prob(self, points: Array) -> Array:
        """Return log densities, shape (n,)."""
        joint = self.log_weight + _gaussian_log_prob(points, self.mean, self.factor)
        return np.asarray(log_sum_exp(joint, axis=1))

    def assign(self, points: Array) -> NDArray[np.intp]:
        """Return the likeliest component of each point, shape (n,)."""
        joint = self.log_weight + _gaussian_log_prob(points, self.mean, self.factor)
        return joint.argmax(1)


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


def _mahalanobis(z: Array, mean: Array, factor: Array) -> tuple[Array, Array]:
    """Return squared distances, shape (n, k), and log volumes, shape (k,)."""
    inverse = np.linalg.inv(factor)
    square = np.stack(
        [(((z - m) @ i.T) ** 2).sum(1) for m, i in zip(mean, inverse, strict=True)], 1
    )
    return square, np.log(np.abs(np.diagonal(factor, axis1=1, axis2=2))).sum(1)


def _gaussian_log_prob(z: Array, mean: Array, factor: Array) -> Array:
    square, log_volume = _mahalanobis(z, mean, factor)
    return -0.5 * (square + z.shape[1] * np.log(2 * np.pi)) - log_volume

"""Kernel mixtures around weighted draws, which follow a bent posterior."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln, logsumexp

from sbi_active.inference.sampling.population import Proposal

__all__ = ["EitherProposal", "KernelProposal"]

Array = NDArray[Any]

FREEDOM = 5.0  # of the Student kernels
NUM_KERNELS = 120
NEIGHBORS = 0.1  # share of the draws that shape one kernel
WIDTH = 1.2  # of a kernel, in deviations of its neighbors
SHARE_OF_BASE = 0.05
BLOCK = 2_000


@dataclass(frozen=True)
class KernelProposal:
    r"""Student kernels at draws, each shaped as the draws around it, and a base.

    .. math::
        g(z) = (1 - \epsilon) \frac1k \sum_j t_\nu(z; z_j, w^2 S_j)
        + \epsilon\, g_0(z)

    Attributes:
        location: :math:`z_j`, shape (k, d).
        factor: Lower Cholesky factors of :math:`w^2 S_j`, shape (k, d, d).
        base: :math:`g_0`.

    References:
        Cornuet, Marin, Mira & Robert, Scand. J. Stat. 2012.
    """

    location: Array
    factor: Array
    base: Proposal

    @staticmethod
    def around(
        z: Array, weight: Array, base: Proposal, rng: np.random.Generator
    ) -> KernelProposal:
        """Return kernels at draws (n, d) chosen by their normalized weights (n,)."""
        d = z.shape[1]
        size = 6 * NUM_KERNELS
        cloud = z[rng.choice(len(z), size=size, p=weight)]
        location = cloud[:NUM_KERNELS]
        overall = np.atleast_2d(np.cov(cloud.T)) + 1e-14 * np.eye(d)
        whiten = np.linalg.inv(np.linalg.cholesky(overall))
        gap = (location @ whiten.T)[:, None] - cloud @ whiten.T
        nearest = np.argpartition((gap**2).sum(-1), int(NEIGHBORS * size), 1)
        group = cloud[nearest[:, : int(NEIGHBORS * size)]]
        offset = group - group.mean(1, keepdims=True)
        local = np.swapaxes(offset, 1, 2) @ offset / group.shape[1]
        # Draws that repeat may be too few for a covariance.
        covariance = local + 0.003 * overall
        factor = WIDTH * np.linalg.cholesky(covariance)
        return KernelProposal(location, factor, base)

    def sample(self, num_samples: int, rng: np.random.Generator) -> Array:
        d = self.location.shape[1]
        num_base = rng.binomial(num_samples, SHARE_OF_BASE)
        num = num_samples - num_base
        kernel = rng.integers(len(self.location), size=num)
        scale = np.sqrt(FREEDOM / rng.chisquare(FREEDOM, (num, 1)))
        step = scale * rng.standard_normal((num, d))
        z = self.location[kernel] + np.einsum("nij,nj->ni", self.factor[kernel], step)
        return np.concatenate([z, self.base.sample(num_base, rng)])

    def log_prob(self, z: Array) -> Array:
        blocks = [self._log_kernels(z[i : i + BLOCK]) for i in range(0, len(z), BLOCK)]
        return np.logaddexp(
            np.log1p(-SHARE_OF_BASE) + np.concatenate([np.zeros(0), *blocks]),
            np.log(SHARE_OF_BASE) + self.base.log_prob(z),
        )

    def _log_kernels(self, z: Array) -> Array:
        d = z.shape[1]
        inverse = np.linalg.inv(self.factor)
        center = (inverse @ self.location[..., None])[..., 0]
        step = np.tensordot(z, inverse, (1, 2)) - center  # (n, k, d)
        constant = (
            gammaln(0.5 * (FREEDOM + d))
            - gammaln(0.5 * FREEDOM)
            - 0.5 * d * np.log(np.pi * FREEDOM)
        )
        log_volume = np.log(np.diagonal(self.factor, axis1=1, axis2=2)).sum(1)
        tail = 0.5 * (FREEDOM + d) * np.log1p((step**2).sum(-1) / FREEDOM)
        total = logsumexp(constant - log_volume - tail, axis=1)
        return np.asarray(total) - np.log(len(self.location))


@dataclass(frozen=True)
class EitherProposal:
    """Two proposals, each as likely.

    Attributes:
        first: One of them.
        second: The other.
    """

    first: Proposal
    second: Proposal

    def sample(self, num_samples: int, rng: np.random.Generator) -> Array:
        num = int(rng.binomial(num_samples, 0.5))
        parts = self.first.sample(num, rng), self.second.sample(num_samples - num, rng)
        return np.concatenate(parts)

    def log_prob(self, z: Array) -> Array:
        both = np.logaddexp(self.first.log_prob(z), self.second.log_prob(z))
        return both - np.log(2.0)

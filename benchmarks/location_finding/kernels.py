"""Kernel mixtures around weighted draws, which follow a bent posterior."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from sbi_active.inference.sampling.mixtures import (
    Defended,
    Proposal,
    StudentMixture,
    log_student,
)

Array = NDArray[Any]

NUM_KERNELS = 120  # a choice: the density of a draw costs one term each
NEIGHBORS = 0.1  # share of the draws that shape one kernel
WIDTH = 1.2  # of a kernel, in deviations of its neighbors
SHARE_OF_BASE = 0.05  # a choice: weights are then below 20 times target over base
#: Of each variance: a ten-thousandth of a deviation, far above what rounding leaves.
RIDGE = 1e-8
RESOLUTION = 1e-7  # of float32 parameters, in the prior's units
BLOCK = 2_000  # draws at once, which bounds the memory


class KernelMixture(StudentMixture):
    """Many Student kernels of equal weight."""

    def sample(self, num_samples: int, rng: np.random.Generator) -> Array:
        """Return draws, shape (n, d)."""
        which = rng.integers(len(self.means), size=num_samples)
        normal = rng.standard_normal((num_samples, self.means.shape[1]))
        square = rng.chisquare(self.freedom, (num_samples, 1)) / self.freedom
        return self.moved(which, normal / np.sqrt(square))

    def log_prob(self, z: Array) -> Array:
        """Return the log density, (n, d) -> (n,)."""
        blocks = [self._log_kernels(z[i : i + BLOCK]) for i in range(0, len(z), BLOCK)]
        return np.concatenate([np.zeros(0), *blocks])

    def _log_kernels(self, z: Array) -> Array:
        inverse = np.linalg.inv(self.factors)
        center = (inverse @ self.means[..., None])[..., 0]
        step = np.tensordot(z, inverse, (1, 2)) - center  # (n, k, d)
        log_volume = np.log(np.diagonal(self.factors, axis1=1, axis2=2)).sum(1)
        each = log_student((step**2).sum(-1), log_volume, z.shape[1])
        return np.asarray(logsumexp(each, axis=1)) - np.log(len(self.means))


class KernelProposal(Defended):
    r"""Student kernels at draws, each shaped as the draws around it, and a base.

    .. math::
        g(z) = (1 - \epsilon) \frac1k \sum_j t_\nu(z; z_j, w^2 S_j)
        + \epsilon\, g_0(z)

    References:
        Cornuet, Marin, Mira & Robert, Scand. J. Stat. 2012.
    """

    @staticmethod
    def around(
        z: Array, weight: Array, base: Proposal, rng: np.random.Generator
    ) -> KernelProposal:
        """Return kernels at draws (n, d) chosen by their normalized weights (n,)."""
        size = 6 * NUM_KERNELS
        cloud = z[rng.choice(len(z), size=size, p=weight)]
        location = cloud[:NUM_KERNELS]
        overall = np.atleast_2d(np.cov(cloud.T))
        # Fewer draws than parameters leave directions without a width.
        least = RIDGE * overall.diagonal() + RESOLUTION**2
        overall = overall + np.diag(least)
        whiten = np.linalg.inv(np.linalg.cholesky(overall))
        gap = (location @ whiten.T)[:, None] - cloud @ whiten.T
        nearest = np.argpartition((gap**2).sum(-1), int(NEIGHBORS * size), 1)
        group = cloud[nearest[:, : int(NEIGHBORS * size)]]
        offset = group - group.mean(1, keepdims=True)
        local = np.swapaxes(offset, 1, 2) @ offset / group.shape[1]
        # Draws that repeat may be too few for a covariance.
        covariance = local + 0.003 * overall
        factor = WIDTH * np.linalg.cholesky(covariance)
        kernels = KernelMixture(location, factor)
        return KernelProposal(kernels, base, SHARE_OF_BASE)

"""Kernel mixtures around weighted draws: the proposals of the reference."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

__all__ = ["KernelMixture", "effective_size", "largest_power", "log_normal"]

DIM = 3
DEGREES = 6  # of freedom of a kernel; even, so that chi^2 is a sum of logs
NUM_KERNELS = 150
NEIGHBORS = 0.2  # share of the draws that shape one kernel
WIDTH = 0.7  # of a kernel, in deviations of its neighbors
PRIOR_SHARE = 0.05  # of every proposal
FEWEST_EFFECTIVE = 150.0  # draws, below which the likelihood is tempered


@dataclass(frozen=True)
class KernelMixture:
    """Student-t kernels and a share of N(0, I).

    Attributes:
        location: Shape (k, 3).
        scale: Lower Cholesky factors, shape (k, 3, 3).
        source: Index of the draw that a kernel sits on, shape (k,).
    """

    location: Tensor
    scale: Tensor
    source: Tensor

    @classmethod
    def around(
        cls, z: Tensor, weight: Tensor, generator: torch.Generator
    ) -> KernelMixture:
        """Return kernels at draws (n, 3) chosen by weight (n,), shaped as these lie.

        A kernel has the covariance of the chosen draws that are nearest to its own
        place, so that the mixture follows a bent posterior.
        """
        chosen = torch.multinomial(weight, 4 * NUM_KERNELS, True, generator=generator)
        cloud = z[chosen]
        overall = torch.cov(cloud.T) + 1e-6 * torch.eye(DIM, dtype=z.dtype)
        whiten = torch.linalg.inv(torch.linalg.cholesky(overall))
        location = cloud[:NUM_KERNELS]
        distance = torch.cdist(location @ whiten.T, cloud @ whiten.T)
        nearest = distance.topk(int(NEIGHBORS * len(cloud)), largest=False).indices
        offset = cloud[nearest] - cloud[nearest].mean(1, keepdim=True)
        local = offset.mT @ offset / nearest.shape[1]
        # Repeated draws may be too few for a covariance; a share of the whole is added.
        covariance = WIDTH**2 * (local + 0.02 * overall)
        return cls(location, torch.linalg.cholesky(covariance), chosen[:NUM_KERNELS])

    def sample(self, num: int, generator: torch.Generator) -> Tensor:
        """Return draws, shape (num, 3)."""
        kernel = torch.randint(len(self.location), (num,), generator=generator)
        uniform = torch.rand(
            num, DEGREES // 2, generator=generator, dtype=torch.float64
        )
        chi_square = -2 * torch.log1p(-uniform).sum(-1, keepdim=True)
        normal = torch.randn(num, DIM, generator=generator, dtype=torch.float64)
        student = normal * (DEGREES / chi_square).sqrt()
        z = self.location[kernel] + (self.scale[kernel] @ student[..., None])[..., 0]
        share = torch.rand(num, 1, generator=generator, dtype=torch.float64)
        return torch.where(share < PRIOR_SHARE, normal, z)

    def log_prob(self, z: Tensor, *, has_sources: bool = False) -> Tensor:
        """Return the log density, shape (n,).

        Args:
            z: Shape (n, 3).
            has_sources: Whether these are the draws that the kernels were chosen from.
                Each is then seen by the kernels of the others alone: its own would make
                it look more probable than any new draw there, and so all weights, and
                the evidence, too small.
        """
        inverse = torch.linalg.inv(self.scale)
        offset = torch.einsum("kij,nkj->nki", inverse, z[:, None] - self.location)
        norm = math.lgamma((DEGREES + DIM) / 2) - math.lgamma(DEGREES / 2)
        norm -= 0.5 * DIM * math.log(DEGREES * math.pi)
        log_det = inverse.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        tail = torch.log1p(offset.square().sum(-1) / DEGREES)
        log_kernel = norm + log_det - 0.5 * (DEGREES + DIM) * tail
        others = torch.tensor(float(len(self.location)), dtype=z.dtype)
        if has_sources:
            own = self.source == torch.arange(len(z))[:, None]
            log_kernel = log_kernel.masked_fill(own, -torch.inf)
            others = (~own).sum(-1)
        log_kernels = log_kernel.logsumexp(-1) - others.log()
        return torch.logaddexp(
            log_kernels + math.log1p(-PRIOR_SHARE),
            log_normal(z) + math.log(PRIOR_SHARE),
        )


def largest_power(log_ratio: Tensor, log_likelihood: Tensor) -> float:
    """Return the largest power of the likelihood that leaves enough draws effective."""

    def enough(power: float) -> bool:
        log_weight = log_ratio + power * log_likelihood
        return bool(effective_size(log_weight) >= FEWEST_EFFECTIVE)

    if enough(1.0):
        return 1.0
    low, high = 0.0, 1.0
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if enough(middle) else (low, middle)
    return high  # a power of 0 would count impossible draws


def effective_size(log_weight: Tensor) -> Tensor:
    """Return the effective number of draws, (sum w)^2 / sum w^2."""
    weight = (log_weight - log_weight.max()).exp()
    return weight.sum().square() / weight.square().sum()


def log_normal(z: Tensor) -> Tensor:
    """Return the log density of N(0, I), shape (n,)."""
    return -0.5 * z.square().sum(-1) - 0.5 * DIM * math.log(2 * math.pi)

"""Student-t mixtures fitted to weighted draws: the proposals of the reference."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

__all__ = ["Mixture", "fit_mixture"]

DIM = 4
LOG_2PI = math.log(2 * math.pi)

DEGREES = 8  # of freedom of every Student-t; even, so that chi^2 is a sum of logs
NUM_COMPONENTS = 24  # of the mixture proposal
EM_STEPS = 6  # a stage
PRIOR_SHARE = 0.02  # of a component in its own covariance, in units of all draws
TEMPERED_ESS = 0.3  # share of particles that a step in temperature keeps effective
BLOCK = 2**13  # rows evaluated at once, to stay in the cache


@dataclass(frozen=True)
class Mixture:
    """Student-t mixture: weights (k,), locations (k, 4), lower scales (k, 4, 4)."""

    weight: Tensor
    location: Tensor
    scale: Tensor

    def log_components(self, z: Tensor) -> Tensor:
        """Log of weight times density, shape (n, k)."""
        offset = z[:, None] - self.location
        return self.weight.log() + log_student(offset, invert(self.scale))

    def log_prob(self, z: Tensor) -> Tensor:
        """Log density, shape (n,)."""
        blocks = z.split(BLOCK)
        return torch.cat([self.log_components(b).logsumexp(-1) for b in blocks])

    def sample(self, n: int, generator: torch.Generator | None) -> Tensor:
        """Draw z, shape (n, 4)."""
        k = torch.multinomial(self.weight, n, True, generator=generator)
        return draw_student(self.location[k], self.scale[k], (n, DIM), generator)


def fit_mixture(
    z: Tensor, weight: Tensor, mixture: Mixture | None, generator: torch.Generator
) -> Mixture:
    r"""Fit a mixture to weighted draws by expectation maximisation.

    With responsibilities :math:`\rho_{ik}` and :math:`\gamma_{ik} = (\nu + d) / (\nu +
    |L_k^{-1} (z_i - \mu_k)|^2)`,

    .. math::
        \alpha_k = \sum_i w_i \rho_{ik}, \quad
        \mu_k = \frac{\sum_i w_i \rho_{ik} \gamma_{ik} z_i}
        {\sum_i w_i \rho_{ik} \gamma_{ik}}, \quad
        \Sigma_k = \frac{1}{\alpha_k} \sum_i w_i \rho_{ik} \gamma_{ik}
        (z_i - \mu_k) (z_i - \mu_k)^\top.

    Components start at draws; a small share of the whole covariance keeps each proper.
    """
    overall = torch.cov(z.T, aweights=weight)
    small = overall / NUM_COMPONENTS ** (2 / DIM)
    if mixture is None:
        start = torch.multinomial(weight, NUM_COMPONENTS, True, generator=generator)
        mixture = Mixture(
            torch.full((NUM_COMPONENTS,), 1 / NUM_COMPONENTS, dtype=torch.float64),
            z[start],
            torch.linalg.cholesky(small).expand(NUM_COMPONENTS, DIM, DIM),
        )
    for _ in range(EM_STEPS):
        share = weight[:, None] * mixture.log_components(z).softmax(-1)
        offset = z[:, None] - mixture.location
        scaled = (
            share
            * (DEGREES + DIM)
            / (DEGREES + distance(offset, invert(mixture.scale)))
        )
        alpha = share.sum(0) + 1e-12
        location = (scaled.T @ z) / (scaled.sum(0)[:, None] + 1e-12)
        offset = z[:, None] - location
        spread = torch.einsum("nk,nki,nkj->kij", scaled, offset, offset)
        alpha = (alpha + PRIOR_SHARE / NUM_COMPONENTS) / (1 + PRIOR_SHARE)
        spread = (spread + PRIOR_SHARE / NUM_COMPONENTS * small) / alpha[:, None, None]
        mixture = Mixture(alpha, location, torch.linalg.cholesky(spread))
    return mixture


def next_power(log_ratio: Tensor, log_likelihood: Tensor, power: float) -> float:
    """Return the largest power of the likelihood that keeps enough draws effective."""

    def enough(power: float) -> bool:
        log_weight = log_ratio + power * log_likelihood
        return bool(effective_size(log_weight) >= TEMPERED_ESS * len(log_weight))

    if enough(1.0):
        return 1.0
    low, high = power, 1.0
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if enough(middle) else (low, middle)
    return low


def effective_size(log_weight: Tensor) -> Tensor:
    """Effective number of draws, (sum w)^2 / sum w^2, over the last axis."""
    weight = (log_weight - log_weight.amax(-1, keepdim=True)).exp()
    return weight.sum(-1).square() / weight.square().sum(-1)


def log_normal(z: Tensor) -> Tensor:
    return -0.5 * z.square().sum(-1) - 0.5 * DIM * LOG_2PI


def standard_normal(
    shape: tuple[int, ...], generator: torch.Generator | None
) -> Tensor:
    return torch.randn(shape, generator=generator, dtype=torch.float64)


def invert(scale: Tensor) -> Tensor:
    eye = torch.eye(DIM, dtype=torch.float64).expand_as(scale)
    return torch.linalg.solve_triangular(scale, eye, upper=False)


def distance(offset: Tensor, inverse: Tensor) -> Tensor:
    """Squared length of the whitened offset."""
    return (inverse @ offset[..., None])[..., 0].square().sum(-1)


def log_student(offset: Tensor, inverse: Tensor) -> Tensor:
    """Log density of Student-t densities at offsets (..., 4) from their locations."""
    norm = math.lgamma((DEGREES + DIM) / 2) - math.lgamma(DEGREES / 2)
    norm -= 0.5 * DIM * math.log(DEGREES * math.pi)
    log_det = inverse.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    tail = torch.log1p(distance(offset, inverse) / DEGREES)
    return norm + log_det - 0.5 * (DEGREES + DIM) * tail


def draw_student(
    location: Tensor,
    scale: Tensor,
    shape: tuple[int, ...],
    generator: torch.Generator | None,
) -> Tensor:
    uniform = torch.rand(
        (*shape[:-1], DEGREES // 2), generator=generator, dtype=torch.float64
    )
    chi_square = -2 * torch.log1p(-uniform).sum(-1, keepdim=True)
    normal = standard_normal(shape, generator) * (DEGREES / chi_square).sqrt()
    return location + (scale @ normal[..., None])[..., 0]

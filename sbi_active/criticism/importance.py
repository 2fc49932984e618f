"""Importance sampling of the evidence from a mixture of Student-t distributions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln

from sbi_active.criticism.errors import log_sum_exp
from sbi_active.criticism.rival import Rival

__all__ = ["ImportanceSample", "TMixture", "importance_sample"]

Array = NDArray[Any]

DEGREES_OF_FREEDOM = 5
#: Particles a round, rounds at most, and the effective number that ends them.
ROUND, MAX_ROUNDS, ENOUGH = 400, 4, 100.0
#: Particles that get a t distribution of their own in the next round.
NUM_KERNELS = 30
#: Inflation of a fitted covariance, so that the proposal's tails are the heavier.
INFLATION = 1.5


@dataclass(frozen=True)
class TMixture:
    """Equal-weight mixture of multivariate t distributions.

    Attributes:
        means: Shape (k, dim).
        factors: Lower Cholesky factors of the scale matrices, shape (k, dim, dim).
    """

    means: Array
    factors: Array

    def sample(self, num: int, rng: np.random.Generator) -> Array:
        """Return draws, shape (num, dim)."""
        which = np.arange(num) % len(self.means)
        normal = rng.normal(size=(num, self.means.shape[1]))
        nu = DEGREES_OF_FREEDOM
        t = normal / np.sqrt(rng.chisquare(nu, size=(num, 1)) / nu)
        return self.means[which] + np.einsum("nij,nj->ni", self.factors[which], t)

    def log_prob(self, u: Array) -> Array:
        """Return log densities, shape (n,)."""
        nu, dim = DEGREES_OF_FREEDOM, u.shape[1]
        norm = gammaln(0.5 * (nu + dim)) - gammaln(0.5 * nu)
        norm -= 0.5 * dim * np.log(nu * np.pi)
        parts = []
        for mean, factor in zip(self.means, self.factors, strict=True):
            y = np.linalg.solve(factor, (u - mean).T)
            log_det = np.log(np.diag(factor)).sum()
            tail = 0.5 * (nu + dim) * np.log1p((y**2).sum(0) / nu)
            parts.append(norm - log_det - tail)
        return log_sum_exp(np.stack(parts), axis=0) - np.log(len(parts))


@dataclass(frozen=True)
class ImportanceSample:
    """A weighted sample of a posterior.

    Attributes:
        u: Shape (n, dim).
        weights: Normalized, shape (n,).
        log_evidence: Nats.
        standard_error: Of log_evidence.
        effective_sample_size: 1 / sum of squared weights.
    """

    u: Array
    weights: Array
    log_evidence: float
    standard_error: float
    effective_sample_size: float

    def draws(self, num: int, rng: np.random.Generator) -> Array:
        """Return equally weighted draws in u, shape (num, dim)."""
        return self.u[rng.choice(len(self.u), num, p=self.weights)]


def importance_sample(
    rival: Rival, proposal: TMixture, *, rng: np.random.Generator
) -> ImportanceSample:
    r"""Return the evidence :math:`Z = E_q[p(x | z) p(z) / q(z)]`.

    Where one round leaves few effective particles, the next proposes from t
    distributions around the weighted sample; all rounds count, each particle weighted
    by the mixture of all their proposals.

    Args:
        rival: The model.
        proposal: The first round's.
        rng: Source of the draws.

    References:
        Cornuet et al., Scandinavian Journal of Statistics 39 (2012).
    """
    proposals, parts, targets = [], [], []
    for _ in range(MAX_ROUNDS):
        u = proposal.sample(ROUND, rng)
        target = rival.log_prior(u)
        inside = np.isfinite(target)
        if inside.any():
            target[inside] += rival.log_likelihood(u[inside])
        proposals.append(proposal)
        parts.append(u)
        targets.append(target)
        sample = _weighted(parts, targets, proposals)
        if sample.effective_sample_size >= ENOUGH:
            break
        proposal = _adapted(sample, rng)
    return sample


def _weighted(
    parts: list[Array], targets: list[Array], proposals: list[TMixture]
) -> ImportanceSample:
    u, target = np.concatenate(parts), np.concatenate(targets)
    log_q = log_sum_exp(np.stack([q.log_prob(u) for q in proposals]), axis=0)
    log_w = target - (log_q - np.log(len(proposals)))
    total = log_sum_exp(log_w)
    n = len(u)
    if not np.isfinite(total):
        return ImportanceSample(u, np.full(n, 1 / n), -np.inf, np.inf, 0.0)
    weights = np.exp(log_w - total)
    weights = weights / weights.sum()
    effective = float(1 / (weights**2).sum())
    error = float(np.sqrt(max(n / effective - 1, 0.0) / n))
    return ImportanceSample(u, weights, float(total - np.log(n)), error, effective)


def _adapted(sample: ImportanceSample, rng: np.random.Generator) -> TMixture:
    """Return t distributions around the whole sample and many of its particles.

    The small ones follow a curved ridge, such as that of an effect which a parameter
    can imitate; the wide one keeps the tails.
    """
    dim = sample.u.shape[1]
    # Tempered weights: few particles must not shrink the next proposal to a point.
    flat = np.sqrt(sample.weights)
    flat = flat / flat.sum()
    mean = flat @ sample.u
    centred = sample.u - mean
    cov = (flat[:, None] * centred).T @ centred + 1e-12 * np.eye(dim)
    factor = np.linalg.cholesky(cov)
    heavy = sample.u[rng.choice(len(sample.u), NUM_KERNELS, p=flat)]
    width = (4 / ((dim + 2) * NUM_KERNELS)) ** (1 / (dim + 4))
    return TMixture(
        np.concatenate([mean[None], heavy]),
        np.stack([factor * np.sqrt(INFLATION), *[factor * width] * NUM_KERNELS]),
    )

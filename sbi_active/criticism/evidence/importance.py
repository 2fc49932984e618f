"""Importance sampling of the evidence from a mixture of Student-t distributions."""

from __future__ import annotations

from collections.abc import Callable, Container
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sbi_active.criticism.rivals.rival import Rival
from sbi_active.inference.sampling.eigen import eigh
from sbi_active.inference.sampling.student_mixture import StudentMixture
from sbi_active.inference.sampling.weights import log_sum_exp

Array = NDArray[Any]

#: Particles a round, rounds at most, and the effective number that ends them.
ROUND, MAX_ROUNDS, ENOUGH = 100, 30, 50.0
#: Effective particles that suffice for an evidence far behind another.
ENOUGH_BEHIND = 20.0
#: Effective particles below which a round missed the shape, and rounds after which that
#: is looked at.
MISSED, LOOKS = 15.0, (0, 7)
#: Share of effective particles below which they are looked at for the first time.
POOR = 0.15
#: Share of the particles that a later round spreads over all of its components, and
#: the weight of the component that has the sample's own moments.
DEFENSIVE, OVERALL = 0.5, 0.3
#: Inflation of a fitted covariance, so that the proposal's tails are the heavier.
INFLATION = 1.5
#: Smallest variance of a covariance, as a share of the largest.
SINGULAR = 1e-12


@dataclass(frozen=True)
class ImportanceSample:
    """A weighted sample of a posterior.

    Attributes:
        u: Shape (n, dim).
        weights: Normalized, shape (n,).
        log_evidence: Nats.
        standard_error: Of log_evidence.
        effective_sample_size: 1 / sum of squared weights.
        best: Where other trials are predicted from, shape (dim,); None takes the draws.
    """

    u: Array
    weights: Array
    log_evidence: float
    standard_error: float
    effective_sample_size: float
    best: Array | None = None

    def draws(self, num: int, rng: np.random.Generator) -> Array:
        """Return equally weighted draws in u, shape (num, dim)."""
        return self.u[rng.choice(len(self.u), num, p=self.weights)]


def lower_factors(cov: Array) -> Array:
    """Return lower Cholesky factors of covariances, shape (..., dim, dim).

    One that is singular in floating point, as where a few trials are believed to many
    digits, has its smallest variances raised to 1e-12 of the largest.
    """
    try:
        return np.linalg.cholesky(cov)
    except np.linalg.LinAlgError:
        pass
    safe = np.where(np.isfinite(cov).all((-1, -2), keepdims=True), cov, 0.0)
    values, vectors = eigh(0.5 * (safe + np.swapaxes(safe, -1, -2)))
    least = np.maximum(SINGULAR * values[..., -1:], SINGULAR**2)
    root = vectors * np.sqrt(np.maximum(values, least))[..., None, :]
    upper = np.linalg.qr(np.swapaxes(root, -1, -2), mode="r")
    sign = np.where(np.diagonal(upper, axis1=-2, axis2=-1) < 0, -1.0, 1.0)
    return np.swapaxes(upper * sign[..., None], -1, -2)


def importance_sample(
    rival: Rival,
    proposal: StudentMixture,
    *,
    rng: np.random.Generator,
    local: Callable[[ImportanceSample, int], StudentMixture] | None = None,
    looks: Container[int] = LOOKS,
    missed: float = MISSED,
    enough: float = ENOUGH,
    dismissed: float = -np.inf,
    hopeless: float = -np.inf,
) -> ImportanceSample:
    r"""Return the evidence :math:`Z = E_q[p(x | z) p(z) / q(z)]`.

    Where a round that is looked at leaves few effective particles, and after the first
    that does, the next proposes from ``local``; others propose from the same as before
    with the weights of its components adapted, and with a component of the sample's own
    moments. All rounds count, each particle weighted by the mixture of all their
    proposals.

    Args:
        rival: The model.
        proposal: The first round's.
        rng: Source of the draws.
        local: Returns such a round's proposal, given the sample so far and the round's
            number; None adapts the first.
        looks: Rounds after which the effective particles are looked at, beside the
            first that leaves few.
        missed: Number of them below which the proposal missed the shape.
        enough: Effective sample size that ends the rounds.
        dismissed: Log evidence below which a model hardly counts, so that 20 effective
            particles end them.
        hopeless: Log evidence below which nothing counts once the shape was looked at
            for the last time, however few particles are effective.

    References:
        Cappe et al., Statistics and Computing 18 (2008); Cornuet et al., Scandinavian
        Journal of Statistics 39 (2012).
    """
    proposals: list[StudentMixture] = []
    particles, targets = np.empty((0, proposal.means.shape[1])), np.empty(0)
    log_q = np.empty(0)  # of each particle, summed over the proposals so far
    basis, first = proposal, True
    for i in range(MAX_ROUNDS):
        u = proposal.sample(ROUND, rng)
        target = rival.log_prior(u)
        inside = np.isfinite(target)
        if inside.any():
            target[inside] += rival.log_likelihood(u[inside])
        own = [q.log_prob(u) for q in [*proposals, proposal]]
        log_q = np.logaddexp(log_q, proposal.log_prob(particles))
        log_q = np.append(log_q, log_sum_exp(np.stack(own), axis=0))
        proposals.append(proposal)
        particles, targets = np.concatenate([particles, u]), np.append(targets, target)
        sample = _weighted(particles, targets, log_q - np.log(len(proposals)))
        at_most = sample.log_evidence + 2 * sample.standard_error
        needed = min(enough, ENOUGH_BEHIND) if at_most < dismissed else enough
        if sample.effective_sample_size >= needed:
            break
        if i == LOOKS[-1] and at_most < hopeless:
            break
        few = sample.effective_sample_size < missed
        # A first round that looked well may have missed all that counts.
        few |= first and sample.effective_sample_size < POOR * len(particles)
        if local is not None and few and (first or i in looks):
            proposal, first = local(sample, i), False
            basis = proposal
        else:
            proposal = _adapted(sample, basis)
    return sample


def _weighted(u: Array, target: Array, log_q: Array) -> ImportanceSample:
    log_w = target - log_q
    total = log_sum_exp(log_w)
    n = len(u)
    if not np.isfinite(total):
        return ImportanceSample(u, np.full(n, 1 / n), -np.inf, np.inf, 0.0)
    weights = np.exp(log_w - total)
    weights = weights / weights.sum()
    effective = float(1 / (weights**2).sum())
    error = float(np.sqrt(max(n / effective - 1, 0.0) / n))
    return ImportanceSample(u, weights, float(total - np.log(n)), error, effective)


def _adapted(sample: ImportanceSample, proposal: StudentMixture) -> StudentMixture:
    """Return the proposal with the weights that its components' particles deserve."""
    parts = proposal.log_parts(sample.u)
    share = np.exp(parts - log_sum_exp(parts, axis=0))
    # Tempered weights: few particles must not shrink the next proposal to a point.
    flat = np.sqrt(sample.weights)
    weights = share @ (flat / flat.sum())
    weights = (1 - DEFENSIVE) * weights / weights.sum() + DEFENSIVE / len(weights)
    means, factors, dim = proposal.means, proposal.factors, sample.u.shape[1]
    if sample.effective_sample_size > 3 * dim:
        mean = sample.weights @ sample.u
        apart = sample.u - mean
        cov = (sample.weights[:, None] * apart).T @ apart
        cov += 1e-10 * np.diag(np.diag(cov) + 1e-12)
        means = np.concatenate([means, mean[None]])
        factors = np.concatenate([factors, lower_factors(cov)[None]])
        weights = np.append((1 - OVERALL) * weights, OVERALL)
    return StudentMixture(means, factors, weights)

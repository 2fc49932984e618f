"""Weighted draws of all proposals so far, and the posterior that they make."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from sbi_active.arrays import Array
from sbi_active.inference.engine.potential import Density
from sbi_active.inference.engine.search import Found
from sbi_active.inference.sampling.mixtures import Proposal
from sbi_active.inference.sampling.smc import Bridged
from sbi_active.inference.sampling.weights import effective_sample_size, normalized


@dataclass(frozen=True)
class PriorDraws(Proposal):
    """The prior as a proposal.

    Attributes:
        potential: Density that knows the prior.
    """

    potential: Density

    def sample(self, num_samples: int, rng: np.random.Generator) -> Array:
        """Return draws, shape (n, d)."""
        return self.potential.sample_prior(num_samples, rng)

    def log_prob(self, z: Array) -> Array:
        """Return log densities, shape (n,)."""
        return self.potential.log_prior(z)


@dataclass
class Pool:
    """Draws of all proposals so far that may still count.

    Attributes:
        u: Places, shape (n, d).
        log_prior: Log prior density, shape (n,).
        log_likelihood: Log likelihood of the trials so far, shape (n,).
        log_mixture: Log of the sum over proposals, each times its number of draws.
        log_own: Log density of the proposal that each was drawn from.
        is_final: Mask of those that the posterior rests on, shape (n,).
        num_final: Draws of their proposal, also those that do not count.
        proposals: Pairs of the number of draws and the proposal.
        final: Proposal of the final draws; None if it is not one.
    """

    u: Array
    log_prior: Array
    log_likelihood: Array
    log_mixture: Array
    log_own: Array
    is_final: NDArray[np.bool_]
    num_final: int = 0
    proposals: list[tuple[int, Proposal]] = field(default_factory=list)
    final: Proposal | None = None

    @staticmethod
    def empty(dim: int) -> Pool:
        """Return a pool without draws."""
        no, none = np.zeros((0, dim)), np.zeros(0)
        return Pool(no, none, none, none, none, np.zeros(0, dtype=bool))

    @property
    def log_mixture_weight(self) -> Array:
        """Log weights of all draws, to fit the next proposal with, shape (n,)."""
        return self.log_prior + self.log_likelihood - self.log_mixture

    @property
    def log_weight(self) -> Array:
        """Log weights of the posterior, shape (n,); -inf if it does not rest."""
        log_weight = self.log_prior + self.log_likelihood - self.log_own
        return np.where(self.is_final, log_weight, -np.inf)

    @property
    def log_evidence(self) -> float:
        """Log of the integral of prior times likelihood."""
        if not self.is_final.any():
            return -np.inf
        return float(logsumexp(self.log_weight) - np.log(self.num_final))

    @property
    def effective_sample_size(self) -> float:
        r""":math:`(\sum w_i)^2 / \sum w_i^2` of the posterior's draws."""
        return effective_sample_size(self.log_weight)

    @property
    def divergence(self) -> float:
        r"""Divergence of a normal fit to the posterior's draws, in nats a parameter.

        Draws z without mean, of unit covariance, and of weights w err by

        .. math::
            \frac{1}{d} \sum_i w_i^2 \Bigl(\frac{|z_i|^2}{2} +
            \frac{|z_i|^4 - 2 |z_i|^2 + d}{4}\Bigr)

        on average: by (d + 3) / 4 n if they are n and normal, and by more where tails
        are heavy or draws in the tails have large weights. Few draws hide them, so that
        it is no less than this.
        """
        dim, effective = self.u.shape[1], max(self.effective_sample_size, 1e-9)
        least = (dim + 3) / (4 * effective)
        if effective <= 2 * dim:
            return least
        weight = normalized(self.log_weight[self.is_final])
        off = self.u[self.is_final] - weight @ self.u[self.is_final]
        cov = (off * weight[:, None]).T @ off
        square = (off * np.linalg.lstsq(cov, off.T, rcond=None)[0].T).sum(1)
        terms = square / 2 + (square**2 - 2 * square + dim) / 4
        return max(least, float(weight**2 @ terms) / dim)

    @property
    def missed(self) -> float:
        """Share of the posterior, by all draws, where each final one is outweighed."""
        if self.final is None:
            return 0.0
        log_weight = self.log_prior + self.log_likelihood - self.final.log_prob(self.u)
        beyond = ~self.is_final & (log_weight > self.log_weight.max())
        return float(normalized(self.log_mixture_weight)[beyond].sum())

    @property
    def standard_error(self) -> float:
        """Standard error of log_evidence."""
        effective, num = self.effective_sample_size, max(self.num_final, 1)
        square = max(1 / max(effective, 1e-9) - 1 / num, 0.0)
        of_mass = 0.0 if self.final is None else self.final.error
        return float(np.hypot(np.sqrt(square), of_mass))

    def restart(self) -> None:
        """Rest the posterior on draws to come."""
        self.is_final, self.num_final = np.zeros_like(self.is_final), 0
        self.final = None

    def add(
        self,
        proposal: Proposal,
        drawn: Array,
        potential: Density,
        floor: float = -np.inf,
        *,
        is_final: bool = True,
    ) -> None:
        """Simulate draws of a proposal, shape (n, d), and weigh all.

        Args:
            proposal: Proposal that they were drawn from.
            drawn: The draws.
            potential: Potential of all trials.
            floor: Log of prior times likelihood below which a draw is given up. Where
                the prior excludes the best fit, the posterior lies far below the
                likelihood's peak.
            is_final: Whether the posterior rests on them.
        """
        u = potential.simulated(drawn)
        log_prior = potential.log_prior(u)
        u, log_prior = u[np.isfinite(log_prior)], log_prior[np.isfinite(log_prior)]
        log_likelihood = potential.log_likelihood(u, floor=floor - log_prior)
        counts = np.isfinite(log_likelihood)
        u, log_prior = u[counts], log_prior[counts]
        log_likelihood = log_likelihood[counts]
        own = np.log(len(drawn)) + proposal.log_prob(self.u)
        self.log_mixture = np.logaddexp(self.log_mixture, own)
        count = len(drawn)
        if self.proposals and self.proposals[-1][1] is proposal:
            count += self.proposals.pop()[0]
        log_mixture, log_own = np.full(len(u), -np.inf), proposal.log_prob(u)
        for num, each in self.proposals if len(u) else []:
            log_mixture = np.logaddexp(log_mixture, np.log(num) + each.log_prob(u))
        log_mixture = np.logaddexp(log_mixture, np.log(count) + log_own)
        self.proposals.append((count, proposal))
        self.u = np.concatenate([self.u, u])
        self.log_prior = np.concatenate([self.log_prior, log_prior])
        self.log_likelihood = np.concatenate([self.log_likelihood, log_likelihood])
        self.log_mixture = np.concatenate([self.log_mixture, log_mixture])
        self.log_own = np.concatenate([self.log_own, log_own])
        self.is_final = np.concatenate([self.is_final, np.full(len(u), is_final)])
        if is_final:
            self.num_final, self.final = self.num_final + len(drawn), proposal


@dataclass(frozen=True, kw_only=True)
class WeightedDraws:
    """Weighted draws of a posterior, with its evidence.

    Attributes:
        u: Draws in the potential's coordinates, shape (n, d).
        weight: Weights of the draws, which sum to 1, shape (n,).
        log_evidence: Log of the integral of prior times likelihood, nats.
        standard_error: Standard error of log_evidence, nats.
        effective_sample_size: Number of draws that count.
        method: Method that gave the draws, "importance" or "smc".
    """

    u: Array
    weight: Array
    log_evidence: float
    standard_error: float
    effective_sample_size: float
    method: str

    def draws(self, num: int, rng: np.random.Generator) -> Array:
        """Return equally weighted draws, shape (num, d)."""
        return self.u[rng.choice(len(self.u), num, p=self.weight)]


@dataclass(frozen=True, kw_only=True)
class Fit(WeightedDraws):
    """The posterior of a potential.

    Attributes:
        log_likelihood: Log likelihood of each draw, shape (n,).
        tail_shape: Shape of the tail of the weights; NaN where they are equal.
        is_rough: Whether the likelihood had to be tempered often.
        free: Parameters that keep their prior, shape (d,).
        found: Result of the search; None if it got nowhere.
        particles: Particles of sequential Monte Carlo; None of importance sampling.
        final: Proposal of the draws; None of particles.
        num_drawn: Number of draws, also those that do not count.
        num_stages: Number of proposals that were tried.
    """

    log_likelihood: Array
    tail_shape: float = np.nan
    is_rough: bool = False
    free: NDArray[np.bool_]
    found: Found | None
    particles: Bridged | None = None
    final: Proposal | None = None
    num_drawn: int
    num_stages: int = 1

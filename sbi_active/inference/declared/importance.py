r"""Posterior under declared noise, by adaptive importance sampling.

Proposals are fitted to all draws so far, weighted under the mixture of all proposals.
Those weights are too small: a proposal is dense where the draws it was fitted to were,
and the more so the rougher the likelihood. So the posterior rests on the draws of the
last proposals alone, each weighted under its own, fixed before it was drawn from:

.. math::
    w_i = \frac{p(z_i)\, L(z_i)}{g_{s(i)}(z_i)}, \qquad
    \hat Z = \frac1n \sum_i w_i, \qquad E \hat Z = Z,

with L simulated and so exact. Nothing is smooth in it, and it takes a jump of the
response as it is. Half of every proposal is wide, around draws by a power of the whole
likelihood: what lies between the peaks that were found counts, or shows as few
effective draws, and does not just go missing.

References:
    Cornuet, Marin, Mira & Robert, Scand. J. Stat. 2012 (adaptive multiple importance
    sampling); Cappe et al., J. Comp. Graph. Stat. 2004 (population Monte Carlo);
    Chopin, Biometrika 2002 (one trial after another).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import logsumexp

from sbi_active.inference.declared.simulated_likelihood import SimulatedLikelihood
from sbi_active.inference.sampling.coordinates import PriorCoordinates
from sbi_active.inference.sampling.kernels import EitherProposal, KernelProposal
from sbi_active.inference.sampling.student_mixture import Proposal
from sbi_active.inference.sampling.tempering import largest_power
from sbi_active.inference.sampling.weights import effective_sample_size, normalized

Array = NDArray[Any]

NEGLIGIBLE = 25.0  # nats below the best draw, beyond which a draw is given up
FEWEST = 60.0  # effective draws, below which the likelihood is tempered
BROAD = 150.0  # effective draws that shape the wide half of a proposal
MAX_STAGES = 40  # the budget ends sooner unless draws repeat, which cost nothing


@dataclass
class WeightedPool:
    """Draws of all proposals so far that may still count.

    Attributes:
        z: Coordinates, shape (n, d).
        log_prior: Log prior density, shape (n,).
        log_likelihood: Of the trials so far, shape (n,).
        log_mixture: Log of the sum over proposals, each times its number of draws.
        log_own: Log density of the proposal that each was drawn from.
        is_final: Which of them the posterior rests on.
        num_final: Draws of their proposals, also those that do not count.
        proposals: Pairs of the number of draws and the proposal.
        num_trials: Trials in the likelihood.
    """

    z: Array
    log_prior: Array
    log_likelihood: Array
    log_mixture: Array
    log_own: Array
    is_final: NDArray[np.bool_]
    num_final: int = 0
    proposals: list[tuple[int, Proposal]] = field(default_factory=list)
    num_trials: int = 0

    @staticmethod
    def empty(dim: int) -> WeightedPool:
        """Return a pool without draws."""
        none = np.zeros(0)
        return WeightedPool(
            np.zeros((0, dim)), none, none, none, none, np.zeros(0, dtype=bool)
        )

    @property
    def log_mixture_weight(self) -> Array:
        """To fit the next proposal with, shape (n,)."""
        return self.log_prior + self.log_likelihood - self.log_mixture

    @property
    def log_weight(self) -> Array:
        """Of the posterior, shape (n,); -inf for draws that it does not rest on."""
        log_weight = self.log_prior + self.log_likelihood - self.log_own
        return np.where(self.is_final, log_weight, -np.inf)

    @property
    def log_evidence(self) -> float:
        """Log of the integral of prior times likelihood."""
        if not self.is_final.any():
            return -np.inf
        return float(logsumexp(self.log_weight) - np.log(self.num_final))

    @property
    def weight(self) -> Array:
        """Normalized weights, shape (n,)."""
        return normalized(self.log_weight)

    @property
    def effective_sample_size(self) -> float:
        r""":math:`(\sum w_i)^2 / \sum w_i^2`."""
        return effective_sample_size(self.log_weight)

    def restart(self) -> None:
        """Rest the posterior on draws to come."""
        self.is_final, self.num_final = np.zeros_like(self.is_final), 0

    def copy(self) -> WeightedPool:
        """Return a pool that grows apart from this one."""
        return replace(self, proposals=[*self.proposals])

    def add(
        self,
        proposal: Proposal,
        num: int,
        likelihood: SimulatedLikelihood,
        coordinates: PriorCoordinates,
        rng: np.random.Generator,
        floor: float,
    ) -> None:
        """Draw, simulate what may count, and weigh under the mixture of all."""
        z = proposal.sample(num, rng)
        z = z[coordinates.inside(z)]
        theta = coordinates.to_theta(z)
        log_likelihood = likelihood(theta, floor=floor)
        counts = np.isfinite(log_likelihood)
        z = coordinates.to_z(theta[torch.from_numpy(counts)])
        log_prior = coordinates.log_prior(z)
        if len(self.z):
            own = np.log(num) + proposal.log_prob(self.z)
            self.log_mixture = np.logaddexp(self.log_mixture, own)
        self.proposals.append((num, proposal))
        log_mixture = np.full(len(z), -np.inf)
        for count, each in self.proposals if len(z) else []:
            log_mixture = np.logaddexp(log_mixture, np.log(count) + each.log_prob(z))
        self.z = np.concatenate([self.z, z])
        self.log_prior = np.concatenate([self.log_prior, log_prior])
        self.log_likelihood = np.concatenate(
            [self.log_likelihood, log_likelihood[counts]]
        )
        self.log_mixture = np.concatenate([self.log_mixture, log_mixture])
        self.log_own = np.concatenate([self.log_own, proposal.log_prob(z)])
        self.is_final = np.concatenate([self.is_final, np.ones(len(z), dtype=bool)])
        self.num_final += num

    def keep(self, rows: NDArray[np.bool_]) -> None:
        """Drop all other draws; their proposals still count."""
        self.z, self.log_prior = self.z[rows], self.log_prior[rows]
        self.log_likelihood = self.log_likelihood[rows]
        self.log_mixture, self.log_own = self.log_mixture[rows], self.log_own[rows]
        self.is_final = self.is_final[rows]


def importance_sample(
    likelihood: SimulatedLikelihood,
    coordinates: PriorCoordinates,
    rng: np.random.Generator,
    *,
    first: Sequence[tuple[int, Proposal]],
    base: Proposal,
    past: WeightedPool | None = None,
    num_simulations: int,
    num_draws: int,
    num_effective: float,
) -> WeightedPool:
    r"""Return weighted draws of the posterior of all trials.

    Where few draws count, the next proposal is fitted to

    .. math::
        p(z)\, L_{\mathrm{past}}(z)\, L_{\mathrm{new}}(z)^\beta

    with the largest :math:`\beta` that leaves enough of them, up to 1.

    Args:
        likelihood: Of all trials.
        coordinates: Of the prior.
        rng: Source of randomness.
        first: Numbers of draws and proposals to begin with, where there is no past.
        base: Covers the posterior; a share of every proposal.
        past: The pool of the first of these trials.
        num_simulations: To spend; the last stage may exceed it.
        num_draws: A stage.
        num_effective: Effective draws that end it.
    """
    table, num_past = likelihood.table, 0
    stop = table.num_simulations + num_simulations
    if past is None or not len(past.z):
        pool = WeightedPool.empty(coordinates.dim)
        for num, proposal in first:
            pool.add(proposal, num, likelihood, coordinates, rng, -np.inf)
        pool.restart()
        log_past = np.zeros(len(pool.z))
    else:
        pool, num_past = past.copy(), past.num_trials
        pool.keep(
            (past.log_weight > past.log_weight.max() - NEGLIGIBLE)
            | (past.log_mixture_weight > past.log_mixture_weight.max() - NEGLIGIBLE)
        )
        log_past = pool.log_likelihood
        new = likelihood(coordinates.to_theta(pool.z), first=num_past)
        pool.log_likelihood = log_past + new
        log_past = log_past[np.isfinite(new)]
        pool.keep(np.isfinite(new))
    pool.num_trials = len(likelihood)

    reached = 0.0 if pool.effective_sample_size < num_effective else 1.0
    if reached == 0:
        pool.restart()
    for _ in range(MAX_STAGES):
        is_done = reached == 1 and pool.effective_sample_size >= num_effective
        if is_done or not len(pool.z) or table.num_simulations >= stop:
            break
        log_new = pool.log_likelihood - log_past
        power = _largest_power(pool.log_mixture_weight - log_new, log_new)
        if power > reached:
            pool.restart()
            reached = power
        log_weight = pool.log_mixture_weight - (1 - power) * log_new
        weight = normalized(log_weight)
        kernels = EitherProposal(
            KernelProposal.around(pool.z, weight, base, rng),
            KernelProposal.around(pool.z, _flattened(pool), base, rng),
        )
        floor = float(pool.log_likelihood.max()) - NEGLIGIBLE / power
        size = len(pool.z)
        pool.add(kernels, num_draws, likelihood, coordinates, rng, floor)
        # Of what counts every trial has been simulated; this only looks it up.
        theta = coordinates.to_theta(pool.z[size:])
        log_past = np.concatenate([log_past, likelihood(theta, last=num_past)])
    return pool


def _flattened(pool: WeightedPool) -> Array:
    """Return weights of a power of the whole likelihood that leaves many draws.

    A rough likelihood has peaks between those that were found. Proposals around these
    alone would be dense where draws are and nowhere else, and what they miss would
    show in no effective sample size.
    """
    log_rest = pool.log_prior - pool.log_mixture
    power = _largest_power(log_rest, pool.log_likelihood, needed=BROAD)
    log_weight = log_rest + power * pool.log_likelihood
    return normalized(log_weight)


def _largest_power(log_rest: Array, log_new: Array, needed: float = FEWEST) -> float:
    """Return the largest power of a likelihood that leaves enough draws effective."""
    needed = min(needed, 0.5 * effective_sample_size(log_rest))

    def suffices(power: float) -> bool:
        return effective_sample_size(log_rest + power * log_new) >= needed

    return largest_power(suffices)

"""The posterior of a task by importance sampling, from prior and likelihood alone."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from scipy.spatial import KDTree
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.arrays import Array
from sbi_active.inference.sampling.coordinates import (
    NormalCoordinates,
    PriorCoordinates,
)
from sbi_active.inference.sampling.mixtures import (
    Defended,
    Proposal,
    StudentMixture,
)
from sbi_active.inference.sampling.weights import (
    effective_sample_size,
    largest_power,
    log_sum_exp,
    normalized,
    systematic,
)

__all__ = ["SampledPosterior"]

LogLikelihood = Callable[..., Any]


def kernels(
    z: Array,
    share: Array,
    rng: np.random.Generator,
    *,
    num: int = 150,
    each: int = 4,
    neighbors: float = 0.2,
    width: float = 0.5,
) -> StudentMixture:
    """Return t kernels about weighted draws, each shaped as those nearest to it lie.

    Args:
        z: Draws, shape (n, d).
        share: Their weights, shape (n,), summing to 1.
        rng: Source of the places.
        num: Number of kernels.
        each: Repeated draws behind a kernel, on average.
        neighbors: Share of the draws that shape a kernel, so that the mixture follows a
            bent posterior.
        width: Width of a kernel in deviations of its neighbors; its place is as far
            from a draw. On a draw it would make that look more probable than new ones.
    """
    cloud = z[systematic(share, each * num, 0.5)]
    overall = np.atleast_2d(np.cov(cloud.T)) + 1e-6 * np.eye(cloud.shape[1])
    white = np.linalg.solve(np.linalg.cholesky(overall), cloud.T).T
    chosen = rng.choice(len(cloud), num)
    tree = KDTree(white)
    nearest = np.asarray(tree.query(white[chosen], int(neighbors * len(cloud)))[1])
    near = cloud[nearest] - cloud[nearest].mean(1, keepdims=True)
    local = np.swapaxes(near, 1, 2) @ near / near.shape[1]
    # Repeated draws may be too few for a covariance; a share of the whole is added.
    factor = width * np.linalg.cholesky(local + 0.02 * overall)
    step = rng.standard_normal((num, cloud.shape[1], 1))
    return StudentMixture(cloud[chosen] + (factor @ step)[..., 0], factor, freedom=6.0)


class SampledPosterior:
    r"""The posterior :math:`p(\theta \mid \mathcal D)`, nearly exact.

    Draws come from the prior, and then from t kernels about the draws so far, weighted
    by a power of the likelihood that rises to 1. All of them count, under the mixture
    of all proposals (adaptive multiple importance sampling):

    .. math::
        Z = \sum_i w_i, \quad w_i = \frac{p(\mathcal D \mid \theta_i)\,
        p(\theta_i)}{\sum_k n_k q_k(\theta_i)}, \qquad
        \mathrm{se}(\log Z) = \sqrt{1 / \mathrm{ESS} - 1 / n}.

    Beliefs are judged by it: it knows neither their searches nor their proposals.

    Args:
        prior: Prior with a support.
        log_likelihood: Log likelihood of all trials, (n, d) -> (n,). With ``floor=`` it
            may return -inf for rows below.
        num_effective: Effective draws to reach, unless that takes ``most`` draws.
        num_draws: Draws of each proposal.
        most: Draws in all.
        seed: Seed of the draws.
        fewest: Effective draws below which the likelihood is tempered.
        negligible: Nats below the heaviest draw from where one may be given up.
        prior_share: Share of the prior in each proposal, so that no weight is without
            a bound.

    Attributes:
        theta: Draws, shape (n, d), float64.
        weight: Their weights, shape (n,), summing to 1.
        log_evidence: :math:`\log Z` in nats.
        log_evidence_se: Its standard error, and that of every log density. As draws
            shape the proposals, log Z is too small as well: by .01 nats without trials
            of the oscillator, and up to .02 with them, at 12,000 effective draws.
        effective_sample_size: :math:`(\sum_i w_i)^2 / \sum_i w_i^2`.

    Raises:
        ValueError: If no draw explains the trials.

    References:
        Cornuet, Marin, Mira & Robert, Scandinavian Journal of Statistics 39 (2012).
    """

    def __init__(
        self,
        prior: Distribution,
        log_likelihood: LogLikelihood,
        *,
        num_effective: int,
        num_draws: int,
        most: int,
        seed: int = 0,
        fewest: int = 150,
        negligible: float = 16.0,
        prior_share: float = 0.05,
    ) -> None:
        self.prior, self._log_likelihood = prior, log_likelihood
        rng = np.random.default_rng(seed)
        u = NormalCoordinates(PriorCoordinates(prior, rng), rng, keeps_edges=False)
        eye = np.eye(u.dim)[None]
        proposals: list[Proposal] = []
        proposal = base = StudentMixture(np.zeros((1, u.dim)), eye, freedom=np.inf)
        z, log_q, log_l = np.zeros((0, u.dim)), np.zeros(0), np.zeros(0)
        best = -np.inf
        while True:
            new = proposal.sample(num_draws, rng)
            proposals.append(proposal)
            log_q = np.logaddexp(log_q, proposal.log_prob(z)) if len(z) else log_q
            own = log_sum_exp(np.stack([q.log_prob(new) for q in proposals]), axis=0)
            z, log_q = np.concatenate([z, new]), np.concatenate([log_q, own])
            log_ratio = u.log_prior(z) - log_q - np.log(num_draws)
            found = np.full(num_draws, -np.inf)
            rows = np.isfinite(log_ratio[-num_draws:])
            floor = best - negligible - log_ratio[-num_draws:][rows]
            found[rows] = log_likelihood(u.to_theta(new[rows]), floor=floor)
            log_l = np.concatenate([log_l, found])
            log_weight = log_ratio + log_l
            effective = effective_sample_size(log_weight)
            if effective >= num_effective or len(z) >= most:
                break

            def suffices(power: float, r: Array = log_ratio, ll: Array = log_l) -> bool:
                return effective_sample_size(r + power * ll) >= fewest

            power = largest_power(suffices)
            best = log_weight.max() if power == 1 else -np.inf
            around = kernels(z, normalized(log_ratio + power * log_l), rng)
            proposal = Defended(around, base, prior_share)
        if not effective:
            raise ValueError(
                "expected a draw that explains every trial; got none of "
                f"{len(z)}; check which trials are invalid"
            )
        self.theta = u.to_theta(z).double()
        self.weight = torch.from_numpy(normalized(log_weight))
        self.effective_sample_size = effective
        self.log_evidence = float(log_sum_exp(log_weight))
        self.log_evidence_se = float(np.sqrt(1 / effective - 1 / len(z)))

    def log_prob(self, theta: Tensor) -> Tensor:
        """Return log posterior densities, (n, d) -> (n,), float64."""
        theta = theta.float()
        found = self.prior.log_prob(theta).double()
        inside = found.isfinite()
        own = torch.as_tensor(self._log_likelihood(theta[inside])).double()
        found[inside] += own - self.log_evidence
        return found

    def sample(self, num: int, *, seed: int | None = None) -> Tensor:
        """Return draws from the weighted ones, with replacement, shape (num, d).

        Args:
            num: Number of draws.
            seed: Seed of the choice; None uses torch's global generator.
        """
        generator = None if seed is None else torch.Generator().manual_seed(seed)
        rows = torch.multinomial(self.weight, num, True, generator=generator)
        return self.theta[rows]

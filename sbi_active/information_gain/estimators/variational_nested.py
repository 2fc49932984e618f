"""Nested Monte Carlo with the learned posterior as its proposal."""

from __future__ import annotations

import math
import warnings
import zlib
from typing import Any, Protocol

import torch
from torch import Tensor
from torch.distributions import Distribution
from typing_extensions import override

from sbi_active.information_gain.base import (
    Bound,
    CandidateSimulations,
    InformationGainEstimator,
)
from sbi_active.information_gain.critic import Critic
from sbi_active.information_gain.estimators.contrast import (
    BATCH_SIZE,
    at_least,
    log_mean,
)
from sbi_active.information_gain.estimators.evidence import log_density
from sbi_active.seeding import derive_seed, forked_generators


class Proposal(Protocol):
    """A posterior that is drawn from and evaluated, as ``ActionPosterior`` is."""

    def sample_batched(
        self,
        sample_shape: torch.Size,
        x: Tensor,
        action: Tensor,
        *,
        reject_outside_prior: bool,
    ) -> Tensor:
        """Return draws, shape (*sample_shape, n, theta_dim).

        Called with ``reject_outside_prior=False``: draws outside the prior's support
        stay, as log_posterior counts them.
        """
        ...

    def log_posterior(self, theta: Tensor, x: Tensor, action: Tensor) -> Tensor:
        """Return log q(theta_i | x_i, action_i) of such draws, shape (n,)."""
        ...


class VariationalNestedGain(InformationGainEstimator):
    r"""Variational nested Monte Carlo (VNMC).

    .. math::
        U(\xi) = \frac1n \sum_{i=1}^n \log q(x_i | \theta_i, \xi)
        - \log \hat p(x_i | \xi), \qquad
        \hat p(x_i | \xi) = \frac1L \sum_{l=1}^L
        \frac{p(\theta_{il})\, q(x_i | \theta_{il}, \xi)}{t(\theta_{il} | x_i, \xi)},
        \quad t = \tfrac34 q(\theta | x_i, \xi) + \tfrac14 p(\theta)

    A fixed quarter of the draws is from the belief, the others are from the posterior:
    an outcome whose posterior puts them all outside the belief's support would have no
    evidence at all. With the exact likelihood it is an upper bound in expectation, by
    Jensen's inequality, whatever the proposal; where that is good, L need not grow
    with the information. A learned likelihood gives no bound.

    Args:
        proposal: :math:`q(\theta | x, \xi)`; None is the model itself.
        num_contrastive: L, at least 2.
        seed: Seed of the draws.
        batch_size: Rows in one pass of the network.

    Raises:
        ValueError: If ``num_contrastive`` is below 2.

    References:
        Foster et al., NeurIPS 2019 (variational Bayesian optimal experimental design).
    """

    rowwise = True

    def __init__(
        self,
        proposal: Proposal | None = None,
        *,
        num_contrastive: int = 32,
        seed: int = 0,
        batch_size: int = BATCH_SIZE,
    ) -> None:
        self.proposal = proposal
        self.num_contrastive = at_least(num_contrastive, 2, "num_contrastive")
        self.seed, self.batch_size = seed, batch_size

    @override
    def bound_on(self, model: Any) -> Bound:
        return "upper" if getattr(model, "exact_likelihood", False) else "none"

    def _contributions(
        self, model: Any, simulations: CandidateSimulations, belief: Distribution | None
    ) -> Tensor:
        user = type(self).__name__
        likelihood = Critic(model, "log_likelihood", user, self.batch_size)
        proposal = model if self.proposal is None else self.proposal
        if belief is None or not hasattr(proposal, "sample_batched"):
            raise ValueError(
                f"expected a belief and a proposal with sample_batched for {user}; got "
                f"{type(belief).__name__} and {type(proposal).__name__}; pass "
                f"{user}(proposal=ASBI's posterior)"
            )
        posterior = Critic(proposal, "log_posterior", user, self.batch_size)
        key = zlib.crc32(simulations.theta.numpy(force=True).tobytes())
        counted = torch.nonzero(simulations.counted.flatten())[:, 0]
        theta, action = simulations.rows()
        gains = []
        with forked_generators(derive_seed(self.seed, "variational", key)):
            for outcomes in simulations.outcomes():
                x = outcomes.flatten(0, 1)
                gain = torch.full((len(x),), torch.nan, dtype=torch.float64)
                for rows in counted.split(
                    max(1, self.batch_size // self.num_contrastive)
                ):
                    given = x[rows], action[rows]
                    own = likelihood.rows(given[0], theta[rows], given[1])
                    log_p = log_mean(self._terms(likelihood, posterior, belief, *given))
                    gain[rows] = torch.where(own == -torch.inf, own, own - log_p)
                gains.append(gain)
        return torch.stack(gains).mean(0).reshape(simulations.x.shape[:2])

    def _terms(
        self,
        likelihood: Critic,
        posterior: Critic,
        belief: Distribution,
        x: Tensor,
        action: Tensor,
    ) -> Tensor:
        """Return log p(theta_il) q(x_i | theta_il) / t(theta_il | x_i), (n, L)."""
        n, m = len(x), self.num_contrastive
        num_belief = max(1, m // 4)
        share = num_belief / m
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Capping max_sampling_batch_size")
            warnings.filterwarnings("ignore", ".*reject_outside_prior")
            drawn = posterior.model.sample_batched(
                torch.Size([m - num_belief]),
                x=x,
                action=action,
                reject_outside_prior=False,
            )
        defensive = belief.sample(torch.Size([num_belief, n]))
        theta = torch.cat([drawn, defensive]).transpose(0, 1).flatten(0, 1)
        rows = x.repeat_interleave(m, 0), theta, action.repeat_interleave(m, 0)
        log_term = log_density(belief, theta)
        inside = log_term > -torch.inf  # a likelihood is not asked outside the support
        rows = [part[inside] for part in rows]
        log_p = log_term[inside]
        log_q = posterior.rows(*rows)
        log_t = torch.logaddexp(math.log1p(-share) + log_q, math.log(share) + log_p)
        log_term[inside] += likelihood.rows(*rows) - log_t
        return log_term.reshape(n, m)

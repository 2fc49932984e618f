"""Outcomes beside what other draws of the belief would have given."""

from __future__ import annotations

import math
import zlib
from abc import abstractmethod
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.information_gain.base import (
    CandidateSimulations,
    InformationGainEstimator,
)
from sbi_active.information_gain.critic import Critic
from sbi_active.seeding import derive_seed, forked_generators

BATCH_SIZE = 50_000  # rows in one pass of a network; bounds memory
FEWEST = 64  # outcomes at a time: a table runs its network once for each such block
NEAR = 1.0  # nats to the log of a number of draws, within which too few are effective


class Contrast(InformationGainEstimator):
    r"""Log likelihood less the log of an evidence from L contrastive draws.

    .. math::
        U(\xi) = \frac1n \sum_{i=1}^n
        \log q(x_i | \theta_i, \xi) - \log \hat p(x_i | \xi)

    with :math:`\hat p` a mean of likelihoods at :math:`\theta'_l \sim p(\theta)`, l =
    1, ..., L, the same for all outcomes and candidates, and others for other
    simulations, so that the halves that choose and report share none. What a draw
    does to the evidences of all outcomes is counted with the outcomes l mod n, hence
    errors from contributions include it.

    Args:
        num_contrastive: Number of contrastive draws L.
        seed: Seed of the draws.
        batch_size: Rows in one pass of the network.

    Raises:
        ValueError: If ``num_contrastive`` is below 1.
    """

    def __init__(
        self,
        *,
        num_contrastive: int = 500,
        seed: int = 0,
        batch_size: int = BATCH_SIZE,
    ) -> None:
        self.num_contrastive = at_least(num_contrastive, 1, "num_contrastive")
        self.seed, self.batch_size = seed, batch_size

    @abstractmethod
    def _terms(self, own: Tensor, contrastive: Tensor) -> Tensor:
        """Return the log likelihoods whose mean is the evidence, (n, L) or (n, L + 1).

        Of log q(x_i | theta_i), shape (n,), and log q(x_i | theta'_l), shape (n, L).
        """

    def _contributions(
        self, model: Any, simulations: CandidateSimulations, belief: Distribution | None
    ) -> Tensor:
        user = type(self).__name__
        critic = Critic(model, "log_likelihood", user, self.batch_size)
        theta = self._draw(belief, simulations)
        gain = torch.full(simulations.x.shape[:2], torch.nan, dtype=torch.float64)
        for a, counted in enumerate(simulations.counted):
            if bool(counted.any()):
                of_each = [
                    self._of_rows(
                        critic,
                        x[a, counted],
                        simulations.theta[counted],
                        theta,
                        simulations.action[a],
                    )
                    for x in simulations.outcomes()
                ]
                gain[a, counted] = torch.stack(of_each).mean(0)
        return gain

    def _of_rows(
        self, critic: Critic, x: Tensor, theta: Tensor, others: Tensor, action: Tensor
    ) -> Tensor:
        """Contributions of one candidate's outcomes, shape (n,)."""
        n, m = len(x), len(others)
        own = critic.rows(x, theta, action.expand(n, -1))
        log_p = torch.empty(n, dtype=torch.float64)
        share = torch.zeros(m, dtype=torch.float64)  # in the evidences of all outcomes
        for block in torch.arange(n).split(max(FEWEST, self.batch_size // m)):
            terms = self._terms(own[block], critic.table(x[block], others, action))
            log_p[block] = log_mean(terms)
            share += terms.softmax(1)[:, -m:].nan_to_num(0.0).sum(0)
        effect = torch.zeros(n, dtype=torch.float64)
        effect.index_add_(0, torch.arange(m) % n, share - share.mean())
        gain = torch.where(own == -torch.inf, own, own - log_p)
        return gain - effect

    def _draw(
        self, belief: Distribution | None, simulations: CandidateSimulations
    ) -> Tensor:
        if belief is None:
            raise ValueError(
                f"expected a belief for {type(self).__name__} to draw from; got None; "
                "pass the distribution of theta in the simulations"
            )
        key = zlib.crc32(simulations.theta.numpy(force=True).tobytes())
        with forked_generators(derive_seed(self.seed, "contrastive", key)):
            return belief.sample(torch.Size([self.num_contrastive]))


def log_mean(terms: Tensor) -> Tensor:
    """Return the log of the mean of exp(terms), (n, k) -> (n,)."""
    return terms.logsumexp(1) - math.log(terms.shape[1])


def near_limit(gain: Tensor, limits: Sequence[float], text: str) -> list[str]:
    """Return a caution where estimates are near a limit or above it; none elsewhere.

    Args:
        gain: Contributions, shape (a, n).
        limits: Limit of each action, nats.
        text: The caution, with {limit} and {where}.
    """
    mean = gain.nanmean(1)
    near = int((mean > torch.tensor(limits, dtype=mean.dtype) - NEAR).sum())
    where = f"{near} of {len(gain)} actions"
    return [text.format(limit=f"{max(limits):.1f} nats", where=where)] if near else []


def at_least(value: int, least: int, name: str) -> int:
    """Return a count, or raise where it is too small."""
    if value < least:
        raise ValueError(
            f"expected {name} >= {least}; got {value}; use about a hundred or more"
        )
    return value

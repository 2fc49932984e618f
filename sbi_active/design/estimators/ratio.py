"""Information gain by a learned likelihood-to-marginal ratio."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor
from typing_extensions import override

from sbi_active.design.estimators.base import (
    Bound,
    CandidateSimulations,
    InformationGainEstimator,
    at_least,
)
from sbi_active.design.estimators.likelihood import (
    Critic,
    RatioModel,
    log_mean,
    near_limit,
)


class RatioGain(InformationGainEstimator):
    r"""Mean log ratio of likelihood to marginal, the utility of LFIRE.

    .. math::
        U(\xi) = \frac1n \sum_{i=1}^n \log r(x_i, \theta_i | \xi), \qquad
        r(x, \theta | \xi) \approx \frac{p(x | \theta, \xi)}{p(x | \xi)}

    with :math:`\theta_i \sim p`, :math:`x_i \sim p(x | \theta_i, \xi)`. With the exact
    ratio it has no bias, however large the information; a learned one gives no bound,
    as nothing makes its normalization right. Where a network leaves it open
    (multi-class ratio estimation does, up to a function of x) take
    :class:`.InfoNCEGain`.

    Args:
        batch_size: Rows in one pass of the network.

    References:
        Thomas, Dutta, Corander, Kaski & Gutmann, Bayesian Analysis 2022 (LFIRE);
        Kleinegesse, Drovandi & Gutmann, Bayesian Analysis 2021 (the utility).
    """

    rowwise = True

    def __init__(self, *, batch_size: int = 50_000) -> None:
        self.batch_size = batch_size

    def _contributions(
        self, model: RatioModel, simulations: CandidateSimulations, belief: object
    ) -> Tensor:
        critic = Critic(model, "log_ratio", type(self).__name__, self.batch_size)
        theta, action = simulations.rows()
        counted = simulations.counted.flatten()
        gain = torch.full(counted.shape, torch.nan, dtype=torch.float64)
        gain[counted] = torch.stack(
            [
                critic.rows(x.flatten(0, 1)[counted], theta[counted], action[counted])
                for x in simulations.outcomes()
            ]
        ).mean(0)
        return gain.reshape(simulations.x.shape[:2])


class InfoNCEGain(InformationGainEstimator):
    r"""InfoNCE bound with a learned ratio or likelihood as its critic.

    .. math::
        U(\xi) = \frac1K \sum_{i=1}^K \log \frac{e^{f(x_i, \theta_i | \xi)}}
        {\frac1K \sum_{j=1}^K e^{f(x_i, \theta_j | \xi)}}

    on each block of K simulations, :math:`\theta_i \sim p`, :math:`x_i \sim p(x |
    \theta_i, \xi)`, with f the model's ``log_ratio``, or else its ``log_likelihood``.
    It is a lower bound for any f, on simulations that f was not trained on, and does
    not change where f is off by a function of x. It cannot exceed log K, near which
    it does not rank. No further draws of the belief are needed.

    The mean over a block is unchanged; as its simulations share each other's
    parameters, a contribution includes what its own parameters do to the others,

    .. math::
        1 - \sum_{i=1}^K \frac{e^{f(x_i, \theta_j)}}{\sum_k e^{f(x_i, \theta_k)}},

    which has mean zero and makes the error honest.

    Args:
        num_contrastive: L = K - 1, at most; blocks are as equal as they can be.
        batch_size: Rows in one pass of the network.

    Raises:
        ValueError: If ``num_contrastive`` is below 1.

    References:
        van den Oord, Li & Vinyals, 2018; Poole et al., ICML 2019 (bounds of mutual
        information).
    """

    bound: Bound = "lower"

    def __init__(self, *, num_contrastive: int = 127, batch_size: int = 50_000) -> None:
        self.num_contrastive = at_least(num_contrastive, 1, "num_contrastive", 100)
        self.batch_size = batch_size

    def _contributions(
        self, model: Any, simulations: CandidateSimulations, belief: Any
    ) -> Tensor:
        learned = "log_ratio" if hasattr(model, "log_ratio") else "log_likelihood"
        critic = Critic(model, learned, type(self).__name__, self.batch_size)
        gain = torch.full(simulations.x.shape[:2], torch.nan, dtype=torch.float64)
        for a, counted in enumerate(simulations.counted):
            for block in self._blocks(counted):
                theta = simulations.theta[block]
                of_each = []
                for x in simulations.outcomes():
                    f = critic.table(x[a, block], theta, simulations.action[a])
                    own = f.diagonal()
                    bound = torch.where(own == -torch.inf, own, own - log_mean(f))
                    effect = 1 - f.softmax(1).nan_to_num(0.0).sum(0)
                    of_each.append(bound + effect - effect.mean())
                gain[a, block] = torch.stack(of_each).mean(0)
        return gain

    @override
    def cautions(self, gain: Tensor) -> list[str]:
        # the smallest block limits; candidates may have lost rows to faults
        smallest = [
            min((len(block) for block in self._blocks(row.isfinite())), default=1)
            for row in gain
        ]
        return near_limit(
            gain,
            [math.log(size) for size in smallest],
            "InfoNCEGain is near its largest value, log K = {limit}, at {where}: it is "
            "too small there and does not rank; raise num_contrastive",
        )

    def _blocks(self, counted: Tensor) -> tuple[Tensor, ...]:
        """Return the rows of each block, none larger than K."""
        rows = torch.nonzero(counted)[:, 0]
        num_blocks = -(-len(rows) // (self.num_contrastive + 1))
        return rows.tensor_split(num_blocks) if num_blocks else ()

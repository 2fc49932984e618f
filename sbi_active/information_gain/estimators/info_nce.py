"""InfoNCE: which of the simulations' parameters led to an outcome."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor
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
    near_limit,
)


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

    def __init__(
        self, *, num_contrastive: int = 127, batch_size: int = BATCH_SIZE
    ) -> None:
        self.num_contrastive = at_least(num_contrastive, 1, "num_contrastive")
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

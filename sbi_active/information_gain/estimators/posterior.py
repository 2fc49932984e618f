"""The paper's utility: a lower bound from an amortized posterior."""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.information_gain.base import (
    Bound,
    CandidateSimulations,
    InformationGainEstimator,
)


class PosteriorModel(Protocol):
    """Anything with a conditional density of parameters."""

    def log_posterior(self, theta: Tensor, x: Tensor, action: Tensor) -> Tensor:
        """Return log q(theta_i | x_i, action_i), shape (n,)."""
        ...


class PosteriorGain(InformationGainEstimator):
    r"""Barber-Agakov bound, the utility of ASBI.

    .. math::
        U(\xi) = \frac{1}{M} \sum_{i=1}^M
        \log q(\theta_i | x_i, \xi) - \log p(\theta_i)
        \qquad \text{(Eqs. 12-13)}

    with :math:`\theta_i \sim p`, :math:`x_i \sim p(x | \theta_i, \xi)`. For any q,
    :math:`E[U(\xi)] = I(\theta; x | \xi) - E[\mathrm{KL}(p(\theta | x, \xi) \| q)]`,
    so on simulations that q was not trained on it is a lower bound. Its slack differs
    by action: ranking by it is not ranking by information where q is blunter for one
    action than for another. Outcomes at the same parameters are averaged, as they are
    not independent.

    Args:
        batch_size: Rows in one pass of the network; bounds memory.

    References:
        Kim & Matsubara, Applied Intelligence 2025; Barber & Agakov, NeurIPS 2003.
    """

    bound: Bound = "lower"
    rowwise = True

    def __init__(self, *, batch_size: int = 50_000) -> None:
        self.batch_size = batch_size

    def _contributions(
        self,
        model: PosteriorModel,
        simulations: CandidateSimulations,
        belief: Distribution,
    ) -> Tensor:
        density = getattr(belief, "smooth_log_prob", belief.log_prob)
        log_p = density(simulations.theta)
        gains = []
        for x in simulations.outcomes():
            theta, action = simulations.rows()
            rows = [
                part.split(self.batch_size) for part in (theta, x.flatten(0, 1), action)
            ]
            log_q = torch.cat(
                [model.log_posterior(*batch) for batch in zip(*rows, strict=True)]
            )
            gains.append(log_q.reshape(x.shape[:2]) - log_p)
        return torch.stack(gains).mean(0)

"""The utility of likelihood-free inference by ratio estimation."""

from __future__ import annotations

import torch
from torch import Tensor

from sbi_active.information_gain.base import (
    CandidateSimulations,
    InformationGainEstimator,
)
from sbi_active.information_gain.critic import Critic, RatioModel
from sbi_active.information_gain.estimators.contrast import BATCH_SIZE


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

    def __init__(self, *, batch_size: int = BATCH_SIZE) -> None:
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

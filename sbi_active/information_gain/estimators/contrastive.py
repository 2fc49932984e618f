"""Prior contrastive estimation: a lower bound, whatever the likelihood."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from typing_extensions import override

from sbi_active.information_gain.base import Bound
from sbi_active.information_gain.estimators.contrast import Contrast, near_limit


class ContrastiveGain(Contrast):
    r"""Prior contrastive estimation (PCE).

    .. math::
        U(\xi) = \frac1n \sum_{i=1}^n \log q(x_i | \theta_i, \xi)
        - \log \hat p_i(x_i | \xi), \qquad
        \hat p_i(x | \xi) = \frac{1}{L + 1} \left[ q(x | \theta_i, \xi)
        + \sum_{l=1}^L q(x | \theta'_l, \xi) \right]

    with :math:`\theta_i, \theta'_l \sim p`, :math:`x_i \sim p(x | \theta_i, \xi)`. It
    tells :math:`\theta_i` from L others by x and is a lower bound for any positive
    function q, so on simulations that q was not trained on a learned likelihood keeps
    it below the information, if not close. With the exact one it rises to the
    information with L. It cannot exceed log(L + 1), near which it does not rank.

    Args:
        num_contrastive: Number of contrastive draws L.
        seed: Seed of the draws.
        batch_size: Rows in one pass of the network.

    References:
        Foster, Jankowiak, O'Meara, Teh & Rainforth, AISTATS 2020; van den Oord, Li &
        Vinyals, 2018 (the bound for any critic).
    """

    bound: Bound = "lower"

    def _terms(self, own: Tensor, contrastive: Tensor) -> Tensor:
        return torch.cat([own[:, None], contrastive], 1)

    @override
    def cautions(self, gain: Tensor) -> list[str]:
        return near_limit(
            gain,
            [math.log(self.num_contrastive + 1)] * len(gain),
            "ContrastiveGain is near its largest value, log(L + 1) = {limit}, at "
            "{where}: it is too small there and does not rank; raise num_contrastive",
        )

"""The utility of likelihood-based inference: nested Monte Carlo on a likelihood."""

from __future__ import annotations

import math
from typing import Any

from torch import Tensor
from typing_extensions import override

from sbi_active.information_gain.base import Bound
from sbi_active.information_gain.estimators.contrast import Contrast, near_limit


class LikelihoodGain(Contrast):
    r"""Nested Monte Carlo on a likelihood, the utility of ALHI.

    .. math::
        U(\xi) = \frac1n \sum_{i=1}^n \log q(x_i | \theta_i, \xi)
        - \log \hat p(x_i | \xi), \qquad
        \hat p(x | \xi) = \frac1L \sum_{l=1}^L q(x | \theta'_l, \xi)

    with :math:`\theta_i, \theta'_l \sim p`, :math:`x_i \sim p(x | \theta_i, \xi)`. With
    the exact likelihood it is an upper bound in expectation, by Jensen's inequality,
    whose excess is about half the relative variance of :math:`\hat p`: it needs L well
    above the exponential of the information. A learned likelihood gives no bound: to
    the same excess it adds minus the divergence of the posterior that it implies.
    :class:`.NestedGain` does better on few draws where the
    noise is declared.

    Args:
        num_contrastive: Number of contrastive draws L.
        seed: Seed of the draws.
        batch_size: Rows in one pass of the network.

    References:
        Kim & Matsubara, Applied Intelligence 2025 (ALHI, the two equations of section
        5.1); Rainforth et al., ICML 2018 (nested Monte Carlo).

    Example:
        >>> import torch
        >>> from sbi_active.information_gain import CandidateSimulations
        >>> class Scale:
        ...     exact_likelihood = True
        ...     def log_likelihood(self, x, theta, action):
        ...         normal = torch.distributions.Normal(action * theta, 1.0)
        ...         return normal.log_prob(x).sum(-1)
        >>> _ = torch.manual_seed(0)
        >>> prior = torch.distributions.MultivariateNormal(torch.zeros(1), torch.eye(1))
        >>> theta, action = prior.sample((2_000,)), torch.tensor([[2.0], [4.0]])
        >>> x = action[:, None] * theta + torch.randn(2, 2_000, 1)
        >>> rows = CandidateSimulations(theta, action, x)
        >>> gain = LikelihoodGain()(Scale(), rows, prior).mean(1)
        >>> bool((gain - torch.tensor([0.80, 1.42])).abs().max() < 0.15)  # exact values
        True
        >>> LikelihoodGain().bound_on(Scale())
        'upper'
    """

    def _terms(self, own: Tensor, contrastive: Tensor) -> Tensor:
        return contrastive

    @override
    def bound_on(self, model: Any) -> Bound:
        return "upper" if getattr(model, "exact_likelihood", False) else "none"

    @override
    def cautions(self, gain: Tensor) -> list[str]:
        return near_limit(
            gain,
            [math.log(self.num_contrastive)] * len(gain),
            "LikelihoodGain is near log L = {limit} or above at {where}: few of the "
            "draws explain an outcome, and it is too large there; raise "
            "num_contrastive",
        )

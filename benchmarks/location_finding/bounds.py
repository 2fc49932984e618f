r"""Bounds of the total information that a policy gains in T trials.

The expected information of a policy :math:`\pi` is, with the history :math:`h =
(\xi_1, x_1, \ldots, \xi_T, x_T)` that it produces under :math:`\theta_0`,

.. math::
    I(\pi) = E_{p(\theta_0) p(h | \theta_0, \pi)} \left[
    \log p(h | \theta_0) - \log p(h) \right], \qquad
    p(h | \theta) = \prod_t p(x_t | \theta, \xi_t).

The evidence p(h) has no closed form. The sequential prior contrastive estimate (sPCE)
and sequential nested Monte Carlo (sNMC) replace it by L draws of the prior with and
without :math:`\theta_0` among them,

.. math::
    \mathrm{sPCE} = E \left[ \log \frac{p(h | \theta_0)}
    {\frac{1}{L + 1} \sum_{l=0}^{L} p(h | \theta_l)} \right] \le I(\pi) \le
    E \left[ \log \frac{p(h | \theta_0)}
    {\frac1L \sum_{l=1}^{L} p(h | \theta_l)} \right] = \mathrm{sNMC},

so sPCE never exceeds log(L + 1). Where the posterior is narrow, both need as many
draws as the exponential of the information. With draws :math:`\theta_l` from a density
:math:`q(\theta | h)` instead, and :math:`p(\theta_l) / q(\theta_l | h)` as weights of
all likelihoods in the denominators, the same inequalities hold, and the gap closes as
q approaches the posterior (adaptive contrastive estimate; variational nested Monte
Carlo).

References:
    Foster, Ivanova, Malik & Rainforth, ICML 2021, arXiv:2103.02438 (equations 11 and
    14); Foster et al., AISTATS 2020, arXiv:1911.00294 (adaptive contrastive); Foster
    et al., NeurIPS 2019, arXiv:1903.05480 (variational nested).

Kernel mixtures around weighted draws, which follow a bent posterior.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sbi_active.inference.sampling.mixtures import (
    Defended,
    Proposal,
    StudentMixture,
)
from sbi_active.tasks.location_finding.model import log_likelihood

Array = NDArray[Any]

NUM_KERNELS = 120  # a choice: the density of a draw costs one term each
NEIGHBORS = 0.1  # share of the draws that shape one kernel
WIDTH = 1.2  # of a kernel, in deviations of its neighbors
SHARE_OF_BASE = 0.05  # a choice: weights are then below 20 times target over base
#: Of each variance: a ten-thousandth of a deviation, far above what rounding leaves.
RIDGE = 1e-8
RESOLUTION = 1e-7  # of float32 parameters, in the prior's units


class KernelProposal(Defended):
    r"""Student kernels at draws, each shaped as the draws around it, and a base.

    .. math::
        g(z) = (1 - \epsilon) \frac1k \sum_j t_\nu(z; z_j, w^2 S_j)
        + \epsilon\, g_0(z)

    References:
        Cornuet, Marin, Mira & Robert, Scand. J. Stat. 2012.
    """

    @staticmethod
    def around(
        z: Array, weight: Array, base: Proposal, rng: np.random.Generator
    ) -> KernelProposal:
        """Return kernels at draws (n, d) chosen by their normalized weights (n,)."""
        size = 6 * NUM_KERNELS
        cloud = z[rng.choice(len(z), size=size, p=weight)]
        location = cloud[:NUM_KERNELS]
        overall = np.atleast_2d(np.cov(cloud.T))
        # Fewer draws than parameters leave directions without a width.
        least = RIDGE * overall.diagonal() + RESOLUTION**2
        overall = overall + np.diag(least)
        whiten = np.linalg.inv(np.linalg.cholesky(overall))
        gap = (location @ whiten.T)[:, None] - cloud @ whiten.T
        nearest = np.argpartition((gap**2).sum(-1), int(NEIGHBORS * size), 1)
        group = cloud[nearest[:, : int(NEIGHBORS * size)]]
        offset = group - group.mean(1, keepdims=True)
        local = np.swapaxes(offset, 1, 2) @ offset / group.shape[1]
        # Draws that repeat may be too few for a covariance.
        covariance = local + 0.003 * overall
        factor = WIDTH * np.linalg.cholesky(covariance)
        kernels = StudentMixture(location, factor)
        return KernelProposal(kernels, base, SHARE_OF_BASE)


CHUNK = 20_000  # parameters at once
CLOSE = 1.0  # nats below log(L + 1), within which the lower bound is no longer tight


def history_log_likelihood(theta: Tensor, action: Tensor, x: Tensor) -> Tensor:
    r"""Return :math:`\log p(h | \theta) = \sum_t \log p(x_t | \theta, \xi_t)`.

    Args:
        theta: Shape (L, 2 K).
        action: Shape (T, 2).
        x: Shape (T, 1).

    Returns:
        Shape (L,), float64, nats.
    """
    return torch.cat(
        [
            log_likelihood(x, part[:, None].double(), action).sum(1)
            for part in theta.split(CHUNK)
        ]
    )


def contrastive_bounds(
    log_p_true: Tensor,
    log_p: Tensor,
    log_ratio_true: Tensor | float = 0.0,
    log_ratio: Tensor | float = 0.0,
) -> tuple[Tensor, Tensor]:
    r"""Return what histories contribute to both bounds.

    These are sPCE and sNMC with draws of the prior, adaptive contrastive and
    variational nested with draws of a proposal q, which may know the history and not
    :math:`\theta_0`.

    Args:
        log_p_true: :math:`\log p(h | \theta_0)`, shape (n,).
        log_p: :math:`\log p(h | \theta_l)` of the L others, shape (n, L).
        log_ratio_true: :math:`\log p(\theta_0) - \log q(\theta_0 | h)`, shape (n,);
            0 for draws of the prior.
        log_ratio: The same of the L others, shape (n, L).

    Returns:
        Shapes (n,), float64, nats; their means are the estimates.
    """
    log_w_true, log_w = (log_p_true + log_ratio_true).double(), log_p + log_ratio
    num, log_sum = log_w.shape[1], log_w.double().logsumexp(1)
    log_with = torch.logaddexp(log_sum, log_w_true) - math.log(num + 1)
    log_without = log_sum - math.log(num)
    return log_p_true.double() - log_with, log_p_true.double() - log_without


def posterior_bounds(
    particles: Tensor,
    action: Tensor,
    x: Tensor,
    theta_true: Tensor,
    *,
    num_draws: int = 8_000,
    seed: int,
) -> tuple[float, float, float]:
    """Return what one history contributes to both bounds with a fitted proposal.

    The proposal has Student kernels around draws of the posterior, and a share of the
    prior, so that both bounds hold whatever the draws are.

    Args:
        particles: Draws of the posterior, made without the true parameters, (n, 2 K).
        action: Shape (T, 2).
        x: Shape (T, 1).
        theta_true: Shape (2 K,).
        num_draws: L.
        seed: Of the draws.

    Returns:
        Lower and upper, nats, and the effective number of draws.
    """
    rng = np.random.default_rng(seed)
    z = particles.double().numpy()
    base = _StandardNormal(z.shape[1])
    weight = np.full(len(z), 1 / len(z))
    proposal = KernelProposal.around(z, weight, base, rng)
    draws = np.concatenate(
        [theta_true.double().numpy()[None], proposal.sample(num_draws, rng)]
    )
    log_ratio = torch.from_numpy(base.log_prob(draws) - proposal.log_prob(draws))
    log_p = history_log_likelihood(torch.from_numpy(draws), action, x)
    lower, upper = contrastive_bounds(
        log_p[:1], log_p[None, 1:], log_ratio[:1], log_ratio[None, 1:]
    )
    weights = (log_p + log_ratio)[1:].softmax(0)
    return float(lower), float(upper), float(1 / weights.square().sum())


@dataclass(frozen=True)
class _StandardNormal(Proposal):
    """The prior, as a proposal."""

    dim: int

    def sample(self, num_samples: int, rng: np.random.Generator) -> NDArray[np.float64]:
        return rng.standard_normal((num_samples, self.dim))

    def log_prob(self, z: NDArray[np.float64]) -> NDArray[np.float64]:
        return -0.5 * (z**2).sum(1) - 0.5 * self.dim * math.log(2 * math.pi)

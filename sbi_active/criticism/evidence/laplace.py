"""The evidence of a model that is far behind, without sampling."""

from __future__ import annotations

import numpy as np

from sbi_active.criticism.evidence.importance import INFLATION, Array, ImportanceSample
from sbi_active.criticism.evidence.least_squares import Modes
from sbi_active.criticism.rivals.rival import Rival
from sbi_active.inference.sampling.weights import log_sum_exp

#: A choice: the draws are shown and predicted with, and decide nothing.
NUM_DRAWS = 150
LOG_2PI = float(np.log(2 * np.pi))


def laplace_sample(
    rival: Rival, modes: Modes, rng: np.random.Generator
) -> ImportanceSample:
    r"""Return Laplace's evidence, and draws that nobody simulated, the mode first.

    .. math::
        \log Z \approx \log \sum_k p(x | u_k)\, p(u_k)\, \sqrt{|2 \pi \Sigma_k|}

    with the modes' local covariances. Only for a model whose largest likelihood alone
    says that its evidence decides nothing.

    Args:
        rival: The model.
        modes: Its modes.
        rng: Source of the draws.

    References:
        Kass & Raftery, Journal of the American Statistical Association 90 (1995).
    """
    num, dim = modes.u.shape
    target = rival.log_likelihood(modes.u) + rival.log_prior(modes.u)
    factors = modes.proposal.factors[:num] / np.sqrt(INFLATION)
    log_det = np.log(np.diagonal(factors, axis1=1, axis2=2)).sum(1)
    log_z = log_sum_exp(target + 0.5 * dim * LOG_2PI + log_det)
    c = rival.coordinates
    normal = rng.normal(size=(NUM_DRAWS, dim))
    draws = np.clip(modes.u[0] + normal @ factors[0].T, c.low, c.high)
    u: Array = np.concatenate([modes.u[:1], draws])
    inside = np.isfinite(rival.log_prior(u))  # a bound itself may round to beyond
    inside[0] = True
    u = u[inside]
    equal = np.full(len(u), 1 / len(u))
    return ImportanceSample(u, equal, float(log_z), 0.0, float(len(u)))

r"""What summaries tell of a pour by nearest pours alone: a reference for likelihoods.

Approximate Bayesian computation at one action (Beaumont et al., Genetics 2002): the
pours of a bank whose statistics are nearest to the outcome's, with Epanechnikov
weights and linear regression adjustment, smoothed by Gaussian kernels cut at the
prior's bounds.
No likelihood, no process and no exponent are behind it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

from sbi_active.inference.emulation.summaries import learned_statistic

__all__ = ["abc_log_prob"]

Array = NDArray[Any]

NUM_NEAREST = 60
NUM_FOLDS = 5
WIDTH = 0.9  # of Silverman's rule
DEFENSIVE = 0.02  # share of the prior in the density


def abc_log_prob(theta: Array, summary: Array) -> Array:
    """Return log posterior densities of left-out pours, shape (n,).

    Args:
        theta: From the prior, uniform on [0, 1]^3, shape (n, 3).
        summary: Shape (n, q).
    """
    n, told = len(theta), np.zeros(len(theta))
    for k in range(NUM_FOLDS):
        out = np.arange(n) % NUM_FOLDS == k
        statistic, own = learned_statistic(summary[~out], 2 * theta[~out] - 1, seed=0)
        scale = np.maximum(own.std(0), 1e-12)
        there, here = own / scale, statistic(summary[out]) / scale
        told[out] = [
            _adjusted(theta[~out], there - seen, truth)
            for seen, truth in zip(here, theta[out], strict=True)
        ]
    return told


def _adjusted(theta: Array, away: Array, truth: Array) -> float:
    """Return the log density at the truth from pours and how far they are away."""
    distance = np.linalg.norm(away, axis=1)
    near = np.argsort(distance, kind="stable")[:NUM_NEAREST]
    reach = distance[near[-1]] + 1e-12
    weight = np.maximum(1 - (distance[near] / reach) ** 2, 1e-9)
    weight = weight / weight.sum()
    features = np.concatenate([np.ones((len(near), 1)), away[near]], 1)
    gram = (features.T * weight) @ features + 1e-3 * np.eye(features.shape[1])
    slope = np.linalg.solve(gram, (features.T * weight) @ theta[near])
    draws = np.clip(theta[near] - away[near] @ slope[1:], 0, 1)
    sd = np.sqrt((weight[:, None] * (draws - weight @ draws) ** 2).sum(0)) + 1e-3
    width = WIDTH * sd * (weight**2).sum() ** (1 / 7)  # effective rows to the -1/7
    inside = norm.cdf((1 - draws) / width) - norm.cdf(-draws / width)
    kernel = norm.pdf((truth - draws) / width) / width / inside
    density = float(weight @ kernel.prod(1))
    return float(np.log((1 - DEFENSIVE) * density + DEFENSIVE))

r"""What outcomes tell, by learned likelihoods: no further simulation.

.. math::
    I = \mathrm E\left[\log p(x_i | \theta_i) - \log \frac{1}{M + 1}
    \sum_{j = 0}^M p(x_i | \theta_j)\right], \qquad \theta_0 = \theta_i,

which is at most log(M + 1) (Foster et al., AISTATS 2020).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

Array = NDArray[Any]


def mixture_gain(
    mean: Array, variance: Array, root: Array, normal: Array, num_outer: int
) -> Array:
    """Return contributions to the information of the first parameters, (num_outer,).

    Args:
        mean: Mean outcomes at the parameters, shape (m, q).
        variance: Variance of the mean, shape (m, q).
        root: Cholesky factor of the noise, shape (q, q).
        normal: Standard normal numbers, shape (num_outer, q).
        num_outer: Parameters that outcomes are drawn at.
    """
    inverse = np.linalg.inv(root)
    m = mean @ inverse.T
    # Where simulations are few is no property of the outcome: one variance for all.
    v = 1 + (variance @ (inverse**2).T).mean(0) + 0 * m
    x = m[:num_outer] + np.sqrt(v[:num_outer]) * normal
    own = -0.5 * (normal**2 + np.log(v[:num_outer])).sum(1)
    log_volume = 0.5 * np.log(v).sum(1)
    # (x - m)^2 / v summed over numbers, as products of matrices
    square = (x**2) @ (1 / v).T - 2 * x @ (m / v).T + ((m**2) / v).sum(1)
    every = -0.5 * square - log_volume
    keep = np.concatenate([every[:, num_outer:], own[:, None]], 1)
    return own - (logsumexp(keep, 1) - np.log(keep.shape[1]))

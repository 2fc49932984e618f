r"""Weights of models where all of them are wrong.

Probabilities among them are too sure: evidence grows with the samples of a trajectory,
and what every model misses is no noise. Here each left-out part of the trials counts
as one number, with an error of unknown size,

.. math::
    w_m = \mathrm{E}_a \biggl[ \frac{\pi_m M_m(a)^{-f/2}}
    {\sum_k \pi_k M_k(a)^{-f/2}} \biggr], \qquad
    M_m(a) = \sum_i a_i M_{m, i},

with prior probabilities :math:`\pi` and mean squared errors of f parts, whose shares a
are those of the Bayesian bootstrap, so that no model wins by one part alone.

References:
    Yao, Vehtari, Simpson & Gelman, Bayesian Analysis 13 (2018), pseudo-BMA+.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from sbi_active.arrays import Array
from sbi_active.criticism.results import ModelKey
from sbi_active.inference.sampling.weights import log_sum_exp


def weights_by_error(
    square: Mapping[ModelKey, Array],
    log_prior: Mapping[ModelKey, float],
    seed: int,
    *,
    num_bootstrap: int = 400,
) -> dict[ModelKey, float]:
    """Return the weight of each model, largest first, adding up to one.

    Args:
        square: Mean squared errors on left-out parts of the trials, shape (f,); NaN for
            parts that do not count.
        log_prior: Log prior probability of each model, nats.
        seed: Seed of the bootstrap.
        num_bootstrap: Number of draws of the bootstrap, a choice.

    Example:
        >>> one, two = ModelKey(("one",)), ModelKey(("two",))
        >>> error = {one: np.full(6, 1.0), two: np.full(6, 2.0)}
        >>> found = weights_by_error(error, {one: 0.0, two: 0.0}, seed=0)
        >>> {str(key): round(w, 3) for key, w in found.items()}  # 8 to 1
        {'one': 0.889, 'two': 0.111}
    """
    keys = [*square]
    each = np.stack([square[key] for key in keys])  # (m, f)
    each = each[:, np.isfinite(each).all(0)]
    parts = each.shape[1]
    shares = np.random.default_rng(seed).dirichlet(np.ones(parts), num_bootstrap)
    log_w = -0.5 * parts * np.log(shares @ each.T)  # (b, m)
    log_w += np.array([log_prior[key] for key in keys])
    w = np.exp(log_w - log_sum_exp(log_w, axis=1)[:, None]).mean(0)
    return {keys[i]: float(w[i]) for i in np.argsort(-w, kind="stable")}

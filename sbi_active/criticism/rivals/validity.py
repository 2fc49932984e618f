"""Likelihood of which trials have an outcome."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sbi_active.arrays import Array
from sbi_active.criticism.results import Residuals
from sbi_active.inference.sampling.weights import log_sum_exp

#: Probability that a trial has no outcome where the simulator has one, or vice versa.
DISAGREEMENT = 0.02
#: Rates where nothing declared explains the outcomes, equally likely.
UNKNOWN_RATES = (DISAGREEMENT, 0.1, 0.3, 0.5)


def log_outcomes(
    probability: Array, valid: Array, rates: Sequence[float] = (DISAGREEMENT,)
) -> Array:
    r"""Return the log probability of the trials' validity flags.

    .. math::
        \log \frac1R \sum_{\epsilon} \prod_t
        \bigl[(1 - \epsilon)\, q_t + \epsilon\, (1 - q_t)\bigr]

    less its value where all agree for sure, so that flags which say nothing count
    nothing, with :math:`q_t = P(v_t | \theta, \phi, \xi_t)` of the flag :math:`v_t`:
    0 or 1 from a deterministic simulator, the share of its draws from a random one.

    Args:
        probability: Probability of an outcome by the simulator, shape (n, t).
        valid: Mask of the trials that have one, shape (t,).
        rates: :math:`\epsilon`, the R probabilities of disagreement, equally likely.

    Returns:
        Shape (n,), nats.
    """
    q = np.where(valid, probability, 1 - probability)
    each = [np.log((1 - e) * q + e * (1 - q)).sum(-1) for e in rates]
    agreed = len(valid) * np.log1p(-DISAGREEMENT)
    return log_sum_exp(np.stack(each), axis=0) - np.log(len(rates)) - agreed


def surprising_outcomes(residuals: Residuals) -> tuple[list[int], list[int]]:
    """Return places of trials whose validity the model holds for improbable.

    Args:
        residuals: Residuals with the probability of a measurement in each trial.

    Returns:
        Those without a measurement and those with one, of a probability below 1/20.
    """
    p = residuals.probability_valid
    if p is None:
        return [], []
    valid = np.isfinite(residuals.x.reshape(len(p), -1)).any(1)
    lost = np.flatnonzero(~valid & (p > 0.95))
    kept = np.flatnonzero(valid & (p < 0.05))
    return lost.tolist(), kept.tolist()

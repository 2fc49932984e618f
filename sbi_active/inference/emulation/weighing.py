"""A few simulated likelihoods, beside what was learned of them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sbi_active.arrays import Array
from sbi_active.inference.emulation.emulator import (
    EmulatedLikelihood,
    Interpolation,
)
from sbi_active.inference.emulation.pool import TrialRows
from sbi_active.inference.engine.learned import LearnedFit
from sbi_active.inference.sampling.weights import log_sum_exp


def largest_error(
    fits: Sequence[LearnedFit],
    learned: EmulatedLikelihood,
    rows: Sequence[TrialRows],
    z: Array,
    *,
    least: float = -4.0,
) -> float:
    r"""Return the largest error of a log weight at places, nats.

    Weights of the simulated likelihood and of the learned one, each by its mean,

    .. math::
        w_i = \frac{\prod_k p(x_k | f(\theta_i, \xi_k))}{q(\theta_i)}, \qquad
        \hat w_i = \frac{\hat p(x | \theta_i)}{q(\theta_i)}, \qquad
        q = \sum_j \frac{\hat p_j(x | \theta_i)}{Z_j} .

    Places of which a row was lost are left out.

    Args:
        fits: Fits j that gave the places, as many each.
        learned: Learned likelihood.
        rows: Simulations of each trial, those at the places among them.
        z: Places, shape (n, d).
        least: Log weight below which a place counts for nothing, a fiftieth.
    """
    at = [_places_of(own.z, z) for own in rows]
    log_ratios = [
        fit.potential.learned.log_likelihood(z) - fit.log_evidence for fit in fits
    ]
    log_q = log_sum_exp(np.stack(log_ratios), 0)
    # In single precision a draw at the edge of a region may be beyond it.
    kept = np.isfinite(log_q) & np.all([place >= 0 for place in at], axis=0)
    if not kept.any():
        return np.inf
    z, log_q, at = z[kept], log_q[kept], [place[kept] for place in at]
    simulated = np.zeros(len(z))
    for part, group in zip(learned.parts, learned.groups, strict=True):
        assert isinstance(part, Interpolation)
        simulated += part.simulated(rows[group[0]].x[at[group[0]]])
    agrees = [own.agrees[place] for own, place in zip(rows, at, strict=True)]
    simulated = np.where(np.all(agrees, axis=0), simulated, -np.inf)
    if not np.isfinite(simulated).any():
        return np.inf
    log_weights = []
    for log_likelihood in (simulated, learned.log_likelihood(z)):
        log_weight = log_likelihood - log_q
        mean = log_sum_exp(log_weight) - np.log(len(z))
        log_weights.append(np.maximum(log_weight - mean, least))
    return float(np.abs(log_weights[0] - log_weights[1]).max())


def _places_of(known: Array, z: Array) -> NDArray[np.intp]:
    """Return where each of places (n, d) is among those known, (n,); -1 if nowhere."""
    same = (known == z[:, None]).all(2)
    return np.where(same.any(1), same.argmax(1), -1)

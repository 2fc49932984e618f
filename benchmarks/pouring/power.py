r"""The power that a belief takes a learned likelihood to, from left-out pours.

The likelihood is learned from four fifths of the pours and judged on the others: the
power w is the one at which the posterior of a left-out pour's theta,

.. math::
    p_w(\theta | x) = p(x | \theta)^w \Big/ \int p(x | \theta')^w\, p(\theta')
    \, \mathrm d\theta',

has the highest log density at the mean: 1 where the likelihood is right, 0 where it
tells nothing. The prior is uniform on [0, 1]^d.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from benchmarks.pouring.likelihood import ImageLikelihood, observed

Array = NDArray[Any]

NUM_FOLDS = 5
NUM_CELLS = 10  # along each parameter, of the grid that left-out pours are judged on
POWERS = np.linspace(0, 1.2, 13)


def grid(num: int) -> Array:
    """Return the middles of num^3 cells of [0, 1]^3, the last axis fastest."""
    line = (np.arange(num) + 0.5) / num
    return np.stack(np.meshgrid(line, line, line, indexing="ij"), -1).reshape(-1, 3)


def cross_validated(theta: Array, summary: Array, is_empty: Array) -> ImageLikelihood:
    """Return the likelihood with the power that tells left-out pours best.

    Args:
        theta: Parameters, shape (n, 3).
        summary: Summaries, shape (n, q).
        is_empty: Whether no cube is in view, shape (n,).
    """
    cells, n = grid(NUM_CELLS), len(theta)
    log_p = np.zeros((n, len(cells)))
    for k in range(NUM_FOLDS):
        out = np.arange(n) % NUM_FOLDS == k
        fitted = ImageLikelihood.fit(theta[~out], summary[~out], is_empty[~out])
        seen = [
            observed(fitted, summary[i], bool(is_empty[i])) for i in np.nonzero(out)[0]
        ]
        log_p[out] = fitted.at_each(cells, seen)
    place = np.minimum((theta * NUM_CELLS).astype(int), NUM_CELLS - 1)
    index = np.ravel_multi_index(tuple(place.T), (NUM_CELLS,) * 3)
    power = best_power(log_p, log_p[np.arange(len(log_p)), index])
    return replace(ImageLikelihood.fit(theta, summary, is_empty), power=power)


def best_power(log_p: Array, own: Array) -> float:
    """Return the power that tells left-out pours best.

    Args:
        log_p: Log likelihoods at cells of the prior, or draws from it, shape (n, m).
        own: At the truth, shape (n,).
    """
    score = [told_by(power * log_p, power * own)[0].mean() for power in POWERS]
    return float(POWERS[int(np.argmax(score))])


def told_by(log_p: Array, own: Array) -> tuple[Array, Array]:
    """Return log density of the truth, and the mass of what is denser, (n,).

    Args:
        log_p: At cells of the prior, shape (n, m).
        own: At the truth, shape (n,).
    """
    total: Array = np.asarray(logsumexp(log_p, 1))
    mass = np.where(log_p > own[:, None], np.exp(log_p - total[:, None]), 0).sum(1)
    return own - total + np.log(log_p.shape[1]), mass

r"""Scores of models, which of two predicts better, and weights by their errors.

Where all models are wrong, probabilities among them are too sure: evidence grows with
the samples of a trajectory, and what every model misses is no noise. For weights, each
left-out part of the trials counts as one number, with an error of unknown size,

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
from dataclasses import dataclass

import numpy as np
from scipy import stats

from sbi_active.arrays import Array
from sbi_active.criticism.results import OUTLIER, UNEXPLAINED, ModelKey
from sbi_active.inference.sampling.weights import log_sum_exp


@dataclass(frozen=True)
class Scored:
    """Scores of a model, as the rule uses them.

    Attributes:
        log_p: Unnormalized log posterior probability, states of the error summed out.
        square: Mean squared error on each left-out part, in sensor variances and units
            of what is expected of it, (f,): trials to which a fit can but extrapolate
            tell little of a model.
        fitted: Mean squared residual of the fit, in sensor variances.
        state: Most probable state of the error beside the model: None for that of the
            sensor or of a declared effect, or a catch-all.
        beside: Unnormalized log posterior probability beside a residual process, or a
            parameter that differs from trial to trial; NaN takes ``log_p``.
        white: Variance of the white error, in sensor variances: one, or where errors
            are larger without structure what is white in the fit's residual.
    """

    log_p: float
    square: Array
    fitted: float
    state: str | None = UNEXPLAINED
    beside: float = np.nan
    white: float = 1.0

    @property
    def error(self) -> float:
        """Mean squared error on left-out parts, in sensor variances."""
        return float(np.nanmean(self.square))

    def gain(self, other: Scored) -> float:
        """Return the nats that it gains over another model beside a process."""
        gain = self.beside - other.beside
        return self.log_p - other.log_p if np.isnan(gain) else gain

    @property
    def fits(self) -> bool:
        """Whether it leaves the sensor's error, with or without one gross error."""
        return self.state in (None, OUTLIER)

    def excess(self, white: float) -> float:
        """Return the excess of the fit's residual beyond a white error's variance."""
        return max(self.fitted - white, 1e-2)  # so that ratios are finite


def predicts_better(one: Array, other: Array) -> float:
    """Return the probability that a model has the smaller error on a new trial.

    The test is Student's t over the trials' log ratios of mean squared errors.

    Args:
        one: Mean squared errors of the model on left-out trials, shape (f,).
        other: Mean squared errors of the other model.
    """
    some = np.isfinite(one) & np.isfinite(other)
    ratio = np.log(one[some]) - np.log(other[some])
    n = len(ratio)
    error = ratio.std(ddof=1) / np.sqrt(n) + 1e-9
    return float(stats.t.cdf(-ratio.mean() / error, n - 1))


def weights_by_error(
    square: Mapping[ModelKey, Array], log_prior: Mapping[ModelKey, float], seed: int
) -> dict[ModelKey, float]:
    """Return the weight of each model, largest first, adding up to one.

    Args:
        square: Mean squared errors on left-out parts of the trials, shape (f,); NaN for
            parts that do not count.
        log_prior: Log prior probability of each model, nats.
        seed: Seed of the bootstrap, of 400 draws.

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
    shares = np.random.default_rng(seed).dirichlet(np.ones(parts), 400)
    log_w = -0.5 * parts * np.log(shares @ each.T)  # (b, m)
    log_w += np.array([log_prior[key] for key in keys])
    w = np.exp(log_w - log_sum_exp(log_w, axis=1)[:, None]).mean(0)
    return {keys[i]: float(w[i]) for i in np.argsort(-w, kind="stable")}

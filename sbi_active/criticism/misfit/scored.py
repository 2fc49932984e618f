"""Scores of a model, and whether one predicts better than another."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

from sbi_active.arrays import Array
from sbi_active.criticism.results import OUTLIER, UNEXPLAINED


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
    """

    log_p: float
    square: Array
    fitted: float
    state: str | None = UNEXPLAINED
    beside: float = np.nan

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

    @property
    def excess(self) -> float:
        """Excess of the fit's residual beyond the sensor's error."""
        return max(self.fitted - 1, 1e-2)  # so that ratios are finite


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

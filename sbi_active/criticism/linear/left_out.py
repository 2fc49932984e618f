"""Errors on trials that a model was not fitted to, and its intervals.

A model is refitted by least squares without each part of the trials, from its
linearization at the best fit to all.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sbi_active.arrays import Array
from sbi_active.criticism.linear.errors import Errors, Grams
from sbi_active.criticism.linear.mixture import Mixture, either
from sbi_active.criticism.linear.model import LinearModel
from sbi_active.criticism.results import ModelKey
from sbi_active.inference.sampling.least_squares import within


@dataclass(frozen=True)
class LeftOut:
    """Refits of a linear model without each part of the trials.

    Attributes:
        square: Mean squared error of each part, in sensor variances, shape (f,); NaN
            for parts that do not count.
        standard: Mean squared error in units of what the refit without the part expects
            of it: a part that it can only extrapolate to counts for less, shape (f,).
        error: Error of each number by the fit without its part, sensor deviations,
            (N,); NaN where it told of the part's nuisances.
        refits: Coordinates without each part, shape (f, d).
        fit: Coordinates with all parts, shape (d,).
    """

    square: Array
    standard: Array
    error: Array
    refits: Array
    fit: Array

    @property
    def mean_square(self) -> float:
        """Over the parts that count, in sensor variances."""
        return float(np.nanmean(self.square))

    def jackknife(self) -> Array:
        """Return the covariance of the coordinates, shape (d, d).

        References:
            Efron & Stein, Annals of Statistics 9 (1981).
        """
        own = self.refits[np.isfinite(self.square)]
        n = len(own)
        off = own - own.mean(0)
        return (n - 1) / n * off.T @ off


@dataclass(frozen=True)
class Candidate:
    """A model that was fitted.

    Attributes:
        model: Linearized at its best fit.
        grams: Gram matrices of its rows.
        sensor: Posterior with the sensor's error alone.
        beside: Posterior with a residual process beside it, or a parameter that differs
            from trial to trial.
        left: Errors of the model on left-out parts of the trials.
        log_prior: Probability of its set of effects, nats.
    """

    model: LinearModel
    grams: Grams
    sensor: Mixture
    beside: Mixture
    left: LeftOut
    log_prior: float

    @property
    def log_p(self) -> float:
        """Unnormalized log posterior probability with a residual process, nats."""
        return self.log_prior + self.beside.log_evidence

    @property
    def log_p_sensor(self) -> float:
        """Unnormalized log posterior probability with the sensor's error, nats."""
        return self.log_prior + self.sensor.log_evidence

    @property
    def log_p_either(self) -> float:
        """Unnormalized log posterior probability with either, nats."""
        return self.log_prior + either(self.sensor, self.beside)


def leave_out(
    model: LinearModel,
    errors: Errors,
    folds: NDArray[np.bool_] | None = None,
    *,
    weight: Array | float = 1.0,
) -> LeftOut:
    """Return a model's errors on each part of the trials that it was not fitted to.

    Refits are to follow the trials: effects' priors are three times as wide.

    Args:
        model: Linear model.
        errors: Errors, which say what the parts are.
        folds: Parts that count, shape (f,); None takes all.
        weight: Weight of each squared error, in refits and in what is returned, (N,).
    """
    f = errors.num_folds
    use = np.ones(f, bool) if folds is None else folds
    weight = np.broadcast_to(weight, model.num)
    fold, each = (np.resize(a, len(model.residual)) for a in (errors.fold, weight))
    rows = model.rows * np.sqrt(each)[:, None]
    rows[:, 0] -= rows[:, 1:] @ (model.center - model.u)
    scaled = rows / max(float(np.sqrt(np.mean(each * model.residual**2))), 1.0)
    parts = [scaled[fold == j] for j in range(f)]
    gram = np.stack([part.T @ part for part in parts])
    rows, scaled = rows[: model.num], scaled[: model.num]
    gram[~use] = 0.0
    total = gram.sum(0)
    prior = np.diag(1 / model.widened(3.0) ** 2)
    without = total - gram
    low, high = model.low - model.center, model.high - model.center
    refits = bounded(without[:, 1:, 1:] + prior, without[:, 1:, 0], low, high)
    fit = bounded((total[1:, 1:] + prior)[None], total[None, 1:, 0], low, high)[0]
    if not errors.is_scored.all():
        refits = _with_nuisances(refits, scaled, prior, model, errors)
    error = rows[:, 0] - (rows[:, 1:] * refits[errors.fold]).sum(1)
    kept = errors.is_scored
    error = np.where(kept, error, np.nan)
    count = np.bincount(errors.fold[kept], minlength=f)
    square = np.bincount(errors.fold[kept], error[kept] ** 2, f) / count
    # Of models with other units of their residuals errors are compared in the sensor's.
    wide = np.bincount(errors.fold, model.scale**2, f) / np.bincount(errors.fold)
    is_free = (refits > low) & (refits < high)
    precision = total[1:, 1:] + prior
    expected = _expected(scaled, error, errors, precision, is_free) / count
    return LeftOut(
        np.where(use, wide * square, np.nan),
        np.where(use, wide * (square - expected), np.nan),
        model.scale * error,
        refits + model.center,
        fit + model.center,
    )


def standard_errors(
    found: Mapping[ModelKey, Candidate],
    errors: Errors,
    use: NDArray[np.bool_] | None = None,
) -> Callable[[Candidate], Array]:
    """Return a function of a model's squared errors on left-out parts, (f,), cached.

    Trials count as much as the likeliest model has them vary, the same for all models.

    Args:
        found: Fitted models.
        errors: Errors that they share.
        use: Parts of the trials that tell of it; None takes all.
    """
    best = max(found.values(), key=lambda c: c.log_p)
    beside = best.beside
    if use is not None:
        beside = errors.mixture(best.model, best.grams, use, beside=True)
    weight = errors.weight(beside)
    known: dict[ModelKey, Array] = {}

    def standard(c: Candidate) -> Array:
        key = c.model.key
        if key not in known:
            known[key] = leave_out(c.model, errors, use, weight=weight).standard
        return known[key]

    return standard


def bounded(system: Array, right: Array, low: Array, high: Array) -> Array:
    r"""Return the x within bounds that minimize :math:`x^T A x / 2 - b^T x`, (n, d).

    If the best x without bounds were only clipped, other coordinates would keep values
    that are right only with the clipped ones.

    Args:
        system: A, shape (n, d, d), positive definite.
        right: b, shape (n, d).
        low: Lower bounds, shape (d,).
        high: Upper bounds, shape (d,).
    """
    return np.clip(-within(system, -right, 0 * right, low, high), low, high)


def _with_nuisances(
    refits: Array, rows: Array, prior: Array, model: LinearModel, errors: Errors
) -> Array:
    """Return the refits with each part's own nuisances, from its first samples."""
    refits = refits.copy()
    trials = np.unique(errors.measurements.trial)
    for fold, trial in enumerate(trials):
        own = np.flatnonzero(model.trial_of == trial)
        some = rows[(errors.fold == fold) & ~errors.is_scored]
        rest = some[:, 0] - some[:, 1:] @ refits[fold]
        part = some[:, 1 + own]
        precision = prior[np.ix_(own, own)]
        # From the prior's center, where the refit without the part left them.
        refits[fold, own] += np.linalg.solve(part.T @ part + precision, part.T @ rest)
    return refits


def _expected(
    rows: Array,
    error: Array,
    errors: Errors,
    precision: Array,
    is_free: NDArray[np.bool_],
) -> Array:
    r"""Return the part of squared errors that the refits were unsure about, (f,).

    Without a part coordinates have the covariance :math:`P_{-f}`, and by Woodbury's
    identity with :math:`P` of the fit to all

    .. math::
        e^T (I + S P_{-f} S^T)^{-1} e = e^T e - e^T S P S^T e.

    Args:
        rows: Rows in units of the model's own error, shape (N, 1 + d).
        error: Errors on left-out parts, shape (N,).
        errors: Errors, which say what the parts are.
        precision: Precision of the fit to all, the inverse of P, shape (d, d).
        is_free: Coordinates within their bounds without each part, shape (f, d); at a
            bound a coordinate is as good as known.
    """
    found = np.empty(errors.num_folds)
    for j, free in enumerate(is_free):
        own = errors.is_scored & (errors.fold == j)
        pull = rows[own, 1:][:, free].T @ error[own]
        found[j] = pull @ np.linalg.solve(precision[np.ix_(free, free)], pull)
    return found

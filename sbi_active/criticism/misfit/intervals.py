r"""Errors of parameters where every model is wrong.

A posterior given one error model is too narrow: it takes what the simulator gets wrong
for independent from trial to trial. The covariance is

.. math::
    \Sigma = \Sigma_{GLS} + \Delta \Delta^T, \qquad
    \Delta = \hat u_{LSQ} - \hat u_{GLS}

with that of generalized least squares given a residual process, or a parameter that
differs from trial to trial, of which a part is shared by the trials. What weighting the
same residuals differently moves parameters by is an error of them too; beyond a bound
of the prior as well, where the fit stays. It is one matrix, in which parameters make up
for each other as they do in the trials, so that predictions follow from it. Intervals
have

.. math::
    \Sigma + \Sigma_J + \sum_m p_m (\hat u_m - \hat u) (\hat u_m - \hat u)^T

with the jackknife's, which knows no process, and the models m that have further
effects, as probable as they are beside a process: something undeclared may be what
they take up. On tuning seeds of ``benchmarks/misfit`` each term is needed. The center
is that of least squares, which predicts new trials better.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sbi_active.arrays import Array
from sbi_active.criticism.linear.errors import Errors
from sbi_active.criticism.linear.left_out import Candidate
from sbi_active.criticism.linear.mixture import WIDTHS, summed
from sbi_active.criticism.linear.model import LinearModel
from sbi_active.criticism.linear.processes import Filter, Processes, alike
from sbi_active.inference.sampling.mixtures import eigh


def covariance(own: Candidate, errors: Errors, action: Array) -> Array:
    """Return the covariance of a model's coordinates about its best fit, (d, d).

    Args:
        own: Fitted model.
        errors: Errors that all models share.
        action: Action of each trial, shape (t, action_dim).
    """
    given = own.beside.mean, own.beside.cov
    mean, cov = shared_process(own.model, errors, action) or given
    apart = own.model.u - mean
    return cov + np.outer(apart, apart)


def shared_process(
    model: LinearModel, errors: Errors, action: Array
) -> tuple[Array, Array] | None:
    r"""Return the posterior moments given an error that trials may share.

    .. math::
        C = \sigma^2 (I + s^2 A \otimes K) \ \text{or}\
        \sigma^2 (I + s^2 A \otimes j j^T), \qquad
        A_{ij} = c\, e^{-|\Delta\xi|^2 / 2 \ell^2} + (1 - c) \delta_{ij}

    summed over c, the length, s, and the kernel with its time scale or the parameter
    that differs, with derivatives j: what depends on the action, or on the states that
    it leads to, is in part the same in all trials, as a wrong parameter is.

    Args:
        model: Linear model.
        errors: Errors that all models share.
        action: Action of each trial, shape (t, action_dim).

    Returns:
        Shapes (d,) and (d, d); None if trials are not sampled at the same times.
    """
    num = errors.num_folds
    patterns = alike(errors.measurements, errors.fold)
    if not errors.is_by_trial or len(patterns) != 1 or len(patterns[0]) % num:
        return None
    between = _between(action, num)
    parts = [_processes(model, errors, patterns[0], between)]
    if errors.varying.any():
        parts.append(_differing(model, errors, between))
    grams, logs = zip(*parts, strict=True)
    log_p = np.concatenate([log_det - np.log(len(log_det)) for log_det in logs])
    use = np.ones(num, bool)
    gram = np.concatenate(grams) + errors.unchanged(model.rows, use)
    found = summed(gram, log_p, model, WIDTHS if model.key.effects else (1.0,))
    return found.mean, found.cov


def _processes(
    model: LinearModel,
    errors: Errors,
    places: Array,
    between: list[tuple[Array, Array]],
) -> tuple[Array, Array]:
    """Return Gram matrices with a process, (h, k, k), and log constants, (h,).

    Args:
        model: Linear model.
        errors: Errors that all models share.
        places: Numbers of each series, by trial, then channel, shape (b, n).
        between: Eigenvalues and vectors of what trials share, by hypothesis.
    """
    num = errors.num_folds
    blocks = model.rows[places].reshape(num, -1)
    variance = errors.sizes[::2] ** 2  # of which a half tells as much
    variances = np.stack([np.ones(len(variance)), variance], 1)
    own = Processes.grid(variances, errors.times, errors.kernels)
    grams, logs = [], []
    for weights, basis in between:
        # Along these directions trials have processes of their own, of other sizes.
        turned = (basis.T @ blocks).reshape(*places.shape, -1)
        each = own.process[:, None] * np.repeat(weights, len(places) // num)
        filters = Filter(
            replace(own, process=each), errors.measurements.time[places[0]]
        )
        grams.append(filters.grams(turned).sum(1))
        logs.append(-0.5 * filters.log_det.sum(1))
    return np.concatenate(grams), np.concatenate(logs)


def _differing(
    model: LinearModel, errors: Errors, between: list[tuple[Array, Array]]
) -> tuple[Array, Array]:
    """Return Gram matrices with a parameter that differs, (h, k, k), and constants."""
    rows, fold, num = model.rows[: model.num], errors.fold, errors.num_folds
    grams, logs = [], []
    for column in errors.varying.T:
        square = np.bincount(fold, column**2, num)
        pulls = np.stack([np.bincount(fold, column * r, num) for r in rows.T], 1)
        for weights, basis in between:
            root = basis * np.sqrt(weights)
            values, vectors = eigh(root.T @ (square[:, None] * root))
            values, pull = np.maximum(values, 0.0), vectors.T @ (root.T @ pulls)
            size = errors.spreads[:, None] ** 2
            less = size / (1 + size * values)
            taken = np.einsum("st,ti,tj->sij", less, pull, pull)
            grams.append(rows.T @ rows - taken)
            logs.append(-0.5 * np.log1p(size * values).sum(1))
    return np.concatenate(grams), np.concatenate(logs)


def _between(action: Array, num: int) -> list[tuple[Array, Array]]:
    """Return eigenvalues and vectors of what trials share, for each hypothesis.

    They share some of the process, over a length in deviations of the action or all.
    """
    spread = action.std(0)
    some = spread > 0
    scaled = action[:, some] / spread[some]
    square = ((scaled[:, None] - scaled) ** 2).sum(-1)
    found = [(np.ones(num), np.eye(num))]
    for share in (0.5, 0.9):
        for length in (0.7, 1e3) if some.any() else (1e3,):
            kernel = share * np.exp(-0.5 * square / length**2)
            values, vectors = eigh(kernel + (1 - share) * np.eye(num))
            found.append((np.clip(values, 0, None), vectors))
    return found

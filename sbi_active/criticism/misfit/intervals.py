r"""Intervals of parameters where every model is wrong.

A posterior given one error model is too narrow: it takes what the simulator gets wrong
for independent from trial to trial. The variance is

.. math::
    s^2 = t_f^2 \bigl(\max(s_{GLS}, s_J)^2 + (\hat u_{LSQ} - \hat u_{GLS})^2\bigr)
        + \sum_m w_m (\hat u_m - \hat u)^2

with that of generalized least squares given a residual process of which a part is
shared by the trials, and the jackknife's over f trials, :math:`s_J`: what weighting the
same residuals differently moves a parameter by is an error of it too. So is what it is
in other models m, by how well they predict left-out trials: something undeclared may
act as their effects do. :math:`t_f` is Student's quantile in units of the normal one,
since few trials hardly tell how much they differ. The center is that of least squares,
which predicts new trials better.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from sbi_active.criticism.linear.errors import Errors, Posterior
from sbi_active.criticism.linear.left_out import LeftOut
from sbi_active.criticism.linear.mixture import WIDTHS, summed
from sbi_active.criticism.linear.model import LinearModel
from sbi_active.criticism.linear.processes import Filter, Processes, alike
from sbi_active.inference.sampling.eigen import eigh

Array = NDArray[Any]

#: Shares of the process that trials have in common, and the length over which they do,
#: in deviations of the action.
SHARES, LENGTHS = (0.5, 0.9), (0.7, 1e3)
#: Upper end of the central interval that is printed.
QUANTILE = 0.95
#: Every so many of the sizes of the process.
THINNED = 2


def covariances(
    model: LinearModel,
    posterior: Posterior,
    left: LeftOut,
    errors: Errors,
    action: Array,
    between: Array,
) -> tuple[Array, Array]:
    """Return covariances of a model's coordinates about its best fit, (d, d).

    The first is without what coordinates differ by from model to model, the second with
    it.

    Args:
        model: Linear model.
        posterior: Posterior given a process that is independent in each trial.
        left: Refits without each part of the trials.
        errors: Errors that all models share.
        action: Action of each trial, shape (t, action_dim).
        between: Variance of the coordinates from model to model, shape (d,).
    """
    found = shared_process(model, errors, action)
    mean, cov = (posterior.mean, posterior.cov) if found is None else found
    mean = np.clip(mean, model.low, model.high)
    jackknife, apart = left.jackknife(), model.u - mean
    within = np.maximum(np.diag(cov), np.diag(jackknife)) + apart**2
    variance = _few(left.num_parts) ** 2 * within

    def scaled(total: Array, variance: Array) -> Array:
        widest = model.widened(WIDTHS[-1])  # of the prior
        sd = np.minimum(np.sqrt(variance), widest)
        scale = sd / np.sqrt(np.maximum(np.diag(total), 1e-300))
        return total * np.outer(scale, scale)

    # Parameters move together as in any of the three, whose sum is hardly wider.
    total = cov + jackknife + np.outer(apart, apart)
    both = total + np.diag(between), variance + between
    return scaled(total, variance), scaled(*both)


def _few(parts: int) -> float:
    """Return Student's quantile for so many parts in units of the normal one."""
    return float(stats.t.ppf(QUANTILE, max(parts - 1, 1)) / stats.norm.ppf(QUANTILE))


def shared_process(
    model: LinearModel, errors: Errors, action: Array
) -> tuple[Array, Array] | None:
    r"""Return the posterior moments given a process that trials may share.

    .. math::
        C = \sigma^2 (I + s^2 A \otimes K), \qquad
        A_{ij} = c\, e^{-|\Delta\xi|^2 / 2 \ell^2} + (1 - c) \delta_{ij}

    summed over c, the length, s, the kernel and its time scale.

    Args:
        model: Linear model.
        errors: Errors that all models share.
        action: Action of each trial, shape (t, action_dim).

    Returns:
        Shapes (d,) and (d, d); None if trials are not sampled at the same times.
    """
    m, num = errors.measurements, errors.num_folds
    patterns = alike(m, errors.fold)
    if not errors.is_by_trial or len(patterns) != 1:
        return None
    (places,) = patterns  # by trial, then channel
    channels = len(places) // num
    if len(places) != channels * num:
        return None
    blocks = model.rows[places].reshape(num, -1)
    variance = errors.sizes[::THINNED] ** 2
    variances = np.stack([np.ones(len(variance)), variance], 1)
    own = Processes.grid(variances, errors.times, errors.kernels)
    grams, logs = [], []
    for weights, basis in _between(action, num):
        # Along these directions trials have processes of their own, of other sizes.
        turned = (basis.T @ blocks).reshape(*places.shape, -1)
        each = own.process[:, None] * np.repeat(weights, channels)
        filters = Filter(replace(own, process=each), m.time[places[0]])
        grams.append(filters.grams(turned).sum(1))
        logs.append(-0.5 * filters.log_det.sum(1))
    found = summed(np.concatenate(grams), np.concatenate(logs), model)
    return found.mean, found.cov


def _between(action: Array, num: int) -> list[tuple[Array, Array]]:
    """Return eigenvalues and vectors of what trials share, for each hypothesis."""
    spread = action.std(0)
    some = spread > 0
    scaled = action[:, some] / spread[some]
    square = ((scaled[:, None] - scaled) ** 2).sum(-1)
    found = [(np.ones(num), np.eye(num))]
    for share in SHARES:
        for length in LENGTHS if some.any() else LENGTHS[-1:]:
            kernel = share * np.exp(-0.5 * square / length**2)
            values, vectors = eigh(kernel + (1 - share) * np.eye(num))
            found.append((np.clip(values, 0, None), vectors))
    return found

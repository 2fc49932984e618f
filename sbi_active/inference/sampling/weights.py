"""Weighted draws: normalizing, how many count, resampling, tempering, kernel widths."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from sbi_active.arrays import Array


def log_sum_exp(values: Array, axis: int | None = None) -> Any:
    """Return the log of a sum of exponentials over an axis, or over all.

    It is -inf if every term vanishes. It equals SciPy's, in an eighth of its time for
    the few hundred terms of a likelihood that is a sum over a grid.
    """
    top = values.max(axis=axis, keepdims=True)
    top = np.where(np.isfinite(top), top, 0.0)
    with np.errstate(divide="ignore"):
        total = np.log(np.exp(values - top).sum(axis=axis))
    return total + (top.reshape(()) if axis is None else top.squeeze(axis))


def normalized(log_weight: Array) -> Array:
    """Return weights that sum to one, shape (n,), whatever their size.

    Args:
        log_weight: Log weights, shape (n,). Beyond 1e16 a sum of several is lost in the
            rounding of its logarithm; where none is finite, all count the same.
    """
    if not np.isfinite(log_weight).any():
        return np.full(len(log_weight), 1 / len(log_weight))
    weight = np.exp(log_weight - np.asarray(logsumexp(log_weight)))
    total = weight.sum()
    return weight if abs(total - 1) < 1e-9 else weight / total


def effective_sample_size(log_weight: Array) -> float:
    r"""Return :math:`(\sum w_i)^2 / \sum w_i^2`; 0 where no weight is positive.

    Args:
        log_weight: Log weights, not normalized, shape (n,).

    References:
        Kong, Liu & Wong, Journal of the American Statistical Association 89 (1994).
    """
    top = log_weight.max(initial=-np.inf)
    if not np.isfinite(top):
        return 0.0
    weight = np.exp(log_weight - top)
    return float(weight.sum() ** 2 / (weight**2).sum())


def systematic(weight: Array, num: int, offset: float) -> NDArray[np.intp]:
    """Return indices by systematic resampling, ascending, shape (num,).

    Each index is drawn as often as its weight times ``num`` says, rounded up or down.

    Args:
        weight: Normalized weights, shape (n,).
        num: Indices to return.
        offset: Offset, uniform in [0, 1); a fixed one gives indices without randomness.

    References:
        Douc, Cappe & Moulines, Comparison of resampling schemes, ISPA 2005.
    """
    place = (np.arange(num) + offset) / num
    # The cumulative sum ends at one but for rounding.
    return np.minimum(np.searchsorted(np.cumsum(weight), place), len(weight) - 1)


def largest_power(
    suffices: Callable[[float], bool],
    *,
    start: float = 0.0,
    end: float = 1.0,
    least: float = 1e-10,
    num_steps: int = 40,
) -> float:
    """Return the largest power that suffices, between a start and an end.

    The search is by bisection; from 0 by powers of ten first, since where a likelihood
    is narrow the first power may be of the order of 1e-8.

    Args:
        suffices: Whether a power of a likelihood, or of a ratio of densities, leaves
            draws enough effective; true up to the answer and false beyond.
        start: Power that is taken to suffice.
        end: Power that is returned where it suffices.
        least: Gone beyond the start even where that does not suffice, so that a
            sequence of steps moves on.
        num_steps: Number of steps of the bisection.
    """
    if suffices(end):
        return end
    low, high = start, end
    for _ in range(num_steps):
        middle = 0.5 * (low + high) if low > 0 else 0.1 * high
        low, high = (middle, high) if suffices(middle) else (low, middle)
    return max(low, start + least)


def scott(num: float, dim: int) -> float:
    """Return Scott's width, :math:`n^{-1 / (d + 4)}`, of n draws that count.

    References:
        Scott, *Multivariate Density Estimation*, 1992.
    """
    return num ** (-1 / (dim + 4))


def silverman(num: float, dim: int) -> float:
    r"""Return Silverman's width, :math:`(4 / ((d + 2)\, n))^{1 / (d + 4)}`.

    It has the least mean integrated squared error where the draws are normal.

    References:
        Silverman, *Density Estimation for Statistics and Data Analysis*, 1986.
    """
    return (4 / ((dim + 2) * num)) ** (1 / (dim + 4))

r"""Summaries of raw outcomes: checked, and fitted to the simulations at hand.

Few numbers from an outcome of many: what it says of each parameter.

The statistic is the best linear estimate of the parameters from the summary,

.. math::
    s(x) = \hat{\mathrm E}[z | \phi(x)] = \bar z + W^\top (\phi(x) - \bar\phi),

by ridge regression over simulations, its penalty by left-out rows (Fearnhead &
Prangle, J. R. Stat. Soc. B 2012). The statistics of simulations are those of a
regression that did not see them, so that what is then learned about their noise is not
too small.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from sklearn.linear_model import Ridge, RidgeCV
from torch import Tensor

from sbi_active.actions.summaries import SummaryAction, is_fitted
from sbi_active.arrays import Array

PENALTIES = 10.0 ** np.arange(-4.0, 3.1, 0.5)  # of features of unit variance, by row


@dataclass(frozen=True)
class Summary:
    """A summary of raw outcomes, fitted where it is of that kind.

    Attributes:
        label: Name of the summary.
        of: The function, or the fitted object.
        fill: Mean of the raw outcomes it was fitted to, shape (k,), which takes the
            place of what was not measured; None for a function, which gets NaN.
    """

    label: str
    of: Any
    fill: Array | None = None

    def __call__(self, raw: Tensor) -> Array:
        """Return summaries (n, d), float64, of raw outcomes (n, *x_shape).

        NaN where nothing was measured, and whatever the summary makes of a part.

        Raises:
            ValueError: If it returns another shape, or rows depend on their order.
        """
        rows = raw.detach().cpu().float().flatten(1)
        measured = rows.isfinite().any(1)
        some = rows[measured].clone()  # a summary may change what it is given
        if not len(some):
            return np.full((len(rows), 1), np.nan)
        found = self._numbers(some)
        if found.ndim != 2 or len(found) != len(some) or not found.shape[1]:
            raise ValueError(
                f"expected the summary {self.label!r} to map outcomes "
                f"{tuple(some.shape)} to ({len(some)}, d) with d >= 1; got "
                f"{found.shape}; return one row of numbers an outcome"
            )
        result = np.full((len(rows), found.shape[1]), np.nan)
        result[measured.numpy()] = np.where(np.isfinite(found), found, np.nan)
        return result

    def _numbers(self, rows: Tensor) -> Array:
        if self.fill is None:
            found = self.of(rows)
            if isinstance(found, Tensor):
                found = found.detach().cpu().numpy()
            return np.array(found, dtype=np.float64)  # it may be a view of the rows
        x = rows.numpy().astype(np.float64)
        x = np.where(np.isfinite(x), x, self.fill)
        return np.array(self.of.transform(x), dtype=np.float64)


def fitted_summaries(
    choice: SummaryAction | None, raw: Tensor, *, most_fitted: int = 1_000
) -> list[Summary]:
    """Return the summaries of a choice, those that are fitted fitted to copies.

    Args:
        choice: None is the outcome itself.
        raw: Simulated outcomes, shape (n, *x_shape).
        most_fitted: Number of rows at most that a summary is fitted to: an image has
            20,000 numbers.

    Raises:
        ValueError: If one cannot be fitted to so many outcomes.
    """
    if choice is None:
        return [Summary("x", torch.Tensor.double)]
    found = []
    for label, summary in choice.summaries.items():
        if not is_fitted(summary):
            found.append(Summary(label, summary))
            continue
        rows = raw.detach().float().flatten(1)
        rows = rows[rows.isfinite().any(1)]
        rows = rows[:: -(-len(rows) // most_fitted)].double().numpy()
        fill = np.ma.masked_invalid(rows).mean(0).filled(0.0)
        filled = np.where(np.isfinite(rows), rows, fill)
        own = copy.deepcopy(summary)
        try:
            own.fit(filled)
        except ValueError as error:
            raise ValueError(
                f"expected outcomes to fit the summary {label!r} to; got {len(rows)}: "
                f"{error}; allow more simulations a round, or ask for fewer numbers"
            ) from error
        found.append(Summary(label, own, fill))
    return found


@dataclass(frozen=True)
class Statistic:
    """A linear map of summaries (n, q) to statistics (n, s).

    Attributes:
        center: Mean of the summaries, shape (q,).
        scale: Deviation of the summaries, shape (q,); infinite if one never varies.
        weight: Shape (q, s); None keeps the numbers as they are.
        offset: Shape (s,).
    """

    center: Array
    scale: Array
    weight: Array | None
    offset: Array

    def __call__(self, summary: Array) -> Array:
        """Return statistics, shape (n, s)."""
        features = (summary - self.center) / self.scale
        if self.weight is None:
            return features
        return self.offset + features @ self.weight


def is_short(num_numbers: int, dim: int, *, few: int = 2) -> bool:
    """Return whether an outcome stays as it is: a few numbers for each parameter."""
    return num_numbers <= few * dim


def learned_statistic(
    summary: Array, z: Array, *, seed: int, num_folds: int = 10
) -> tuple[Statistic, Array]:
    """Return the statistic of simulations and their own values of it.

    Args:
        summary: Finite summaries, shape (n, q).
        z: Coordinates of their parameters, shape (n, d).
        seed: Seed of the folds.
        num_folds: Number of folds.

    Returns:
        The statistic, and those of the rows by regressions without them, (n, s).
    """
    n, q = summary.shape
    center, scale = summary.mean(0), summary.std(0)
    floor = 1e-7 * np.abs(summary).max(0, initial=0.0)
    # What never varies says nothing, and its rounding must not.
    scale = np.where(scale > floor, scale, np.inf)
    if is_short(q, z.shape[1]) or not np.isfinite(scale).any():
        varies = np.where(np.isfinite(scale), scale, np.maximum(np.abs(center), 1e-30))
        plain = Statistic(center, varies, None, np.zeros(q))
        return plain, plain(summary)
    features = (summary - center) / scale
    size = z.std(0) + 1e-12
    best: Any = RidgeCV(alphas=n * PENALTIES).fit(features, z / size)
    penalty = best.alpha_ / n
    fold = np.random.default_rng(seed).permutation(n) % min(num_folds, n)
    own = np.zeros_like(z)
    for k in range(fold.max() + 1):
        kept = fold != k
        ridge = Ridge(alpha=kept.sum() * penalty).fit(features[kept], z[kept])
        # One center for all: the means of the others would tell who was left out.
        own[~kept] = z.mean(0) + features[~kept] @ ridge.coef_.reshape(len(size), q).T
    ridge = Ridge(alpha=n * penalty).fit(features, z)
    weight = ridge.coef_.reshape(len(size), q).T
    return Statistic(center, scale, weight, np.atleast_1d(ridge.intercept_)), own

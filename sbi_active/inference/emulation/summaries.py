"""Summaries of raw outcomes: checked, and fitted to the simulations at hand."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sbi_active.actions.summaries import SummaryAction, is_fitted

Array = NDArray[Any]

MOST_FITTED = 1_000  # rows that a summary is fitted to: an image has 20,000 numbers


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


def fitted_summaries(choice: SummaryAction | None, raw: Tensor) -> list[Summary]:
    """Return the summaries of a choice, those that are fitted fitted to copies.

    Args:
        choice: None is the outcome itself.
        raw: Simulated outcomes, shape (n, *x_shape).

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
        rows = rows[:: -(-len(rows) // MOST_FITTED)].double().numpy()
        fill = np.nan_to_num(_mean(rows))
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


def _mean(rows: Array) -> Array:
    """Return the mean of what was measured, NaN where nothing was."""
    present = np.isfinite(rows)
    total = np.where(present, rows, 0.0).sum(0)
    with np.errstate(invalid="ignore"):
        return total / present.sum(0)

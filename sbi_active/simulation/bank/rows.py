"""Rows of a bank: those that are meant, and those of a run that are stored."""

from __future__ import annotations

from typing import Any

import numpy as np


def positions(rows: Any, total: int) -> np.ndarray | None:
    """Return the positions of rows, int64; None where all are meant.

    Args:
        rows: Positions, a slice, a mask over all rows, or None.
        total: How many rows there are.

    Raises:
        ValueError: If they are anything else.
    """
    if rows is None:
        return None
    if isinstance(rows, slice):
        return np.arange(*rows.indices(total))
    found = np.asarray(rows)
    if found.dtype == bool and found.shape == (total,):
        return np.flatnonzero(found)
    whole = found.ndim == 1 and found.dtype.kind in "iu"
    if not whole or not bool(((found >= 0) & (found < total)).all()):
        raise ValueError(
            f"expected positions of rows within [0, {total}), or a mask of "
            f"{total}; got {rows!r}; use what columns() is indexed by"
        )
    return found


class StoredIndex:
    """A mask over the rows of one run, which grows as they are added.

    Args:
        run: Name of the run.
    """

    def __init__(self, run: str) -> None:
        self.run = run
        self._mask = np.zeros(0, bool)

    def unseen(self, index: np.ndarray) -> np.ndarray:
        """Return which entries are neither stored nor repeated, shape (k,), bool."""
        fresh = np.zeros(len(index), bool)
        fresh[np.unique(index, return_index=True)[1]] = True
        known = index < len(self._mask)
        fresh[known] &= ~self._mask[index[known]]
        return fresh

    def add(self, index: np.ndarray) -> None:
        """Note rows as stored."""
        if len(index) and index.max() >= len(self._mask):
            # Doubled, so that all growth together copies each entry a few times.
            room = max(2 * len(self._mask), int(index.max()) + 1)
            self._mask = np.pad(self._mask, (0, room - len(self._mask)))
        self._mask[index] = True

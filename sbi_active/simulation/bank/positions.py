"""Which rows of a bank are meant."""

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
    if not whole or (len(found) and not _within(found, total)):
        raise ValueError(
            f"expected positions of rows within [0, {total}), or a mask of "
            f"{total}; got {rows!r}; do use what columns() is indexed by"
        )
    return found


def _within(found: np.ndarray, total: int) -> bool:
    return bool(found.min() >= 0 and found.max() < total)

"""Which rows of a run are stored."""

from __future__ import annotations

import numpy as np


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

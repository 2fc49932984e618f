"""Simulated rows, kept by their parameters."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["SimulatedRows"]

Array = NDArray[Any]
Parts = tuple[Array, "Array | None", Array]


class SimulatedRows:
    """What was simulated once, so that no parameters are simulated twice.

    Rivals that differ in their errors alone ask for the same parameters, a search
    returns to its best point, and draws of a weighted sample repeat.

    Args:
        most: Numbers to keep; beyond that all are forgotten.
    """

    def __init__(self, most: int) -> None:
        self.most, self._size = most, 0
        self._known: dict[tuple[Any, ...], Parts] = {}

    def get(
        self,
        names: Sequence[str],
        rows: Array,
        simulate: Callable[[NDArray[np.int64]], Parts],
    ) -> Parts:
        """Return the parts of all rows, of first axis n, simulating those that are new.

        Args:
            names: What the columns are parameters of.
            rows: Parameters, shape (n, dim).
            simulate: Maps places among the rows to their parts; the second part may be
                None.
        """
        label = (*names,)
        keys = [(label, row.tobytes()) for row in np.ascontiguousarray(rows)]
        found = {key: self._known[key] for key in keys if key in self._known}
        new: dict[tuple[Any, ...], int] = {}
        for i, key in enumerate(keys):
            if key not in found:
                new.setdefault(key, i)
        if new:
            mean, sd, valid = simulate(np.array([*new.values()]))
            for j, key in enumerate(new):
                found[key] = mean[j], None if sd is None else sd[j], valid[j]
            self._size += mean.size * (1 if sd is None else 2) + valid.size
            if self._size > self.most:
                self._known, self._size = {}, 0
            else:
                self._known |= {key: found[key] for key in new}
        means, sds, valids = zip(*[found[key] for key in keys], strict=True)
        joined = None if sds[0] is None else np.stack(sds)
        return np.stack(means), joined, np.stack(valids)

"""Values of rows, kept by the rows' bytes."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from sbi_active.arrays import Array

T = TypeVar("T")


class RowCache(Generic[T]):
    """Cache of simulated rows, so that no parameters are simulated twice.

    A search returns to its best point, draws of a weighted sample repeat, and rivals
    that differ in their errors alone ask for the same parameters. Beyond ``most``
    numbers all are forgotten.
    """

    def __init__(self, most: float = np.inf) -> None:
        self.most, self._size = most, 0
        self._known: dict[tuple[Hashable, bytes], T] = {}

    def get(
        self,
        label: Hashable,
        rows: Array,
        simulate: Callable[[NDArray[np.int64]], Sequence[T]],
    ) -> list[T]:
        """Return the values of all rows, simulating those that are new.

        Args:
            label: Label that the rows belong to, such as an action.
            rows: Parameters, shape (n, dim); always of one dtype for a label.
            simulate: Function that maps places among the rows, shape (m,), to m values:
                arrays, tuples of them, or None.
        """
        keys = [(label, row.tobytes()) for row in np.ascontiguousarray(rows)]
        known, new = self._known, {}
        for i, key in enumerate(keys):
            if key not in known:
                new.setdefault(key, i)
        values: dict[tuple[Hashable, bytes], T] = {}
        if new:
            simulated = simulate(np.array([*new.values()]))
            values = dict(zip(new, simulated, strict=True))
            self._size += sum(_count(value) for value in values.values())
            if self._size > self.most:
                self._known, self._size = {}, 0
            else:
                self._known |= values
        return [values[key] if key in values else known[key] for key in keys]


def _count(value: Any) -> int:
    """Return the count of numbers in a value."""
    if isinstance(value, tuple):
        return sum(_count(part) for part in value)
    return 0 if value is None else value.size

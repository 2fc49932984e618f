"""No row is simulated twice, and all come back in their order."""

from __future__ import annotations

import numpy as np

from sbi_active.inference.sampling.row_cache import RowCache

ROWS = np.array([[1.0, 2.0], [3.0, 4.0], [1.0, 2.0], [5.0, 6.0]])


class Sums:
    """Sums of rows, with a record of what was asked for."""

    def __init__(self) -> None:
        self.asked: list[list[int]] = []

    def of(self, rows: np.ndarray):
        def simulate(at: np.ndarray) -> list[np.ndarray | None]:
            self.asked.append(at.tolist())
            return [None if i == 3 else rows[i].sum(keepdims=True) for i in at]

        return simulate


def test_rows_that_repeat_are_simulated_once():
    cache, sums = RowCache(), Sums()
    assert cache.get("a", ROWS, sums.of(ROWS)) == [3.0, 7.0, 3.0, None]
    assert cache.get("a", ROWS[::-1], sums.of(ROWS)) == [None, 3.0, 7.0, 3.0]
    assert sums.asked == [[0, 1, 3]]


def test_beyond_its_size_all_is_forgotten_after_it_is_returned():
    cache, asked = RowCache(most=3), []
    first, second = np.zeros((1, 2)), np.ones((1, 2))

    def value(row: np.ndarray):
        def simulate(at: np.ndarray):
            asked.append(row[0, 0])
            return [(row[i], None) for i in at]

        return cache.get("a", row, simulate)[0][0]

    for row in (first, second, first):  # two numbers a row: the second does not fit
        assert (value(row) == row[0]).all()
    assert asked == [0, 1, 0]

"""Rows a call in this process, so that an interrupt costs about a second.

A call cannot be interrupted without losing its rows, so a long simulation is cut into
parts. A vectorized simulator takes as long for few rows as for many, and would lose
more by that than an interrupt costs: its parts are as long as they must be.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any
from weakref import WeakKeyDictionary


class Pace:
    """Times that calls of a simulator took: a fixed time and a time a row.

    Example:
        >>> pace = Pace()
        >>> pace.size(2_000)  # nothing is known
        2
        >>> pace.observe(2, 0.02)
        >>> pace.size(1_998)  # 10 ms a row at most
        100
        >>> pace.is_short(100)
        True
    """

    #: A part is sized to take this long.
    SECONDS = 1.0

    #: One that is this much longer is not cut.
    SLACK = 1.5

    #: The share of the fixed time of calls in their time that cutting may cause.
    SHARE = 1 / 32

    #: Rows of the first call. A single one is a shape that simulators may not expect.
    FEWEST = 2

    #: A larger call that takes less than this share of a smaller one shows that the
    #: latter had something to load or to compile.
    WARM = 0.8

    def __init__(self) -> None:
        self._few = self._many = 0, 0.0  # rows and seconds of two calls

    def observe(self, num_rows: int, seconds: float) -> None:
        """Take the time of a call."""
        few, many = self._few[0], self._many[0]
        if num_rows >= 2 * many:
            is_warm = seconds >= self.WARM * self._many[1]
            self._few = self._many if is_warm else (0, 0.0)
            self._many = num_rows, seconds
        elif 2 * num_rows < many or num_rows <= few:
            self._few = num_rows, seconds
        else:
            self._many = num_rows, seconds

    def is_short(self, num_rows: int) -> bool:
        """Return whether rows take too little time to be cut."""
        rows, seconds = self._many
        if not rows:
            return num_rows <= self.FEWEST
        return seconds * max(num_rows / rows, 1.0) <= self.SLACK * self.SECONDS

    def size(self, num_left: int) -> int:
        """Return the rows of the next call, of those that are left."""
        if self.is_short(num_left):
            return num_left
        size = max(int(min(self._wanted(), num_left)), self.FEWEST)
        return size if num_left - size >= self.FEWEST else num_left

    def _wanted(self) -> float:
        """Return rows that take a second, or that make little of the fixed time."""
        (few, least), (rows, seconds) = self._few, self._many
        if not rows:
            return 0.0
        timely = self.SECONDS * rows / seconds  # or less, where some time is fixed
        if not few:
            return max(timely, (2 if seconds > self.SECONDS / 2 else 4) * rows)
        a_row = max((seconds - least) / (rows - few), 1e-12)
        fixed = max(seconds - a_row * rows, 0.0)
        if fixed >= least * few / rows:  # less may be chance
            growth = 256 if seconds < 1.1 * least else min(2 * rows / few, 16)
            timely = max(timely, min(fixed / self.SHARE / a_row, growth * rows))
        # What compiles for each shape is better off with one.
        return rows if timely / 2 <= rows <= 2 * timely else timely


# By the simulator, or by the object and the name of its method. What is known is kept
# from one simulation to the next, so that only the first has to find out.
_PACES: WeakKeyDictionary[Any, dict[str, Pace]] = WeakKeyDictionary()


def pace_of(simulator: Callable[..., Any]) -> Pace:
    """Return the known pace of a simulator in this process."""
    owner = getattr(simulator, "__self__", simulator)
    try:
        paces = _PACES.setdefault(owner, {})
    except TypeError:  # it has no hash, or takes no weak reference
        return Pace()
    return paces.setdefault(getattr(simulator, "__qualname__", ""), Pace())

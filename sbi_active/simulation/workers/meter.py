"""Simulations of a campaign: how many there may be, and where their rows are kept."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Any

from sbi_active.messages import Explained
from sbi_active.simulation.workers.store import RowStore

#: Takes a simulator and returns the store of its rows, or None.
FindStore = Callable[[Callable[..., Any]], RowStore | None]


class SimulationBudgetError(Explained, RuntimeError):
    """More simulations were asked for than are left; none of them was run."""

    code = "SA309"


@dataclass
class Meter:
    """Counts rows that are simulated, those read from a store not among them.

    A row that is tried again after a fault counts once.

    Attributes:
        limit: Rows in all; None for no limit.
        spent: Rows so far.
    """

    limit: int | None = None
    spent: int = 0

    @property
    def left(self) -> float:
        """Rows that are left; infinite without a limit."""
        return math.inf if self.limit is None else max(self.limit - self.spent, 0)

    def spend(self, num_rows: int) -> None:
        """Count rows that are about to be simulated.

        Raises:
            SimulationBudgetError: If fewer are left.
        """
        if num_rows > self.left:
            raise SimulationBudgetError(
                f"expected at most {self.left} further simulations, of max_simulations "
                f"= {self.limit}; got {num_rows}; raise max_simulations"
            )
        self.spent += num_rows


_METER: ContextVar[tuple[Meter, FindStore]] = ContextVar("meter")


@contextmanager
def metering(meter: Meter, find: FindStore = lambda simulator: None) -> Iterator[None]:
    """Count all simulations in the block, and keep those without a store of their own.

    Args:
        meter: Counter of the rows.
        find: Function that returns the store of a simulator's rows.
    """
    token = _METER.set((meter, find))
    try:
        yield
    finally:
        _METER.reset(token)


def spend(num_rows: int) -> None:
    """Count rows by the meter of the block that this is called in, if any."""
    if num_rows:
        _METER.get((Meter(), None))[0].spend(num_rows)


def find_store(simulator: Callable[..., Any]) -> RowStore | None:
    """Return the store of a simulator's rows, if the caller is in :func:`metering`."""
    _, find = _METER.get((None, lambda simulator: None))
    return find(simulator)

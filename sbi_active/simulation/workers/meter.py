"""Numbers of rows that were simulated, and that may be."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass

from sbi_active.messages import Explained


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


_METER: ContextVar[Meter | None] = ContextVar("meter", default=None)


@contextmanager
def metering(meter: Meter) -> Iterator[None]:
    """Count all simulations in the block."""
    token = _METER.set(meter)
    try:
        yield
    finally:
        _METER.reset(token)


def spend(num_rows: int) -> None:
    """Count rows by the meter of the block that this is called in, if any."""
    meter = _METER.get()
    if meter is not None and num_rows:
        meter.spend(num_rows)

"""Simulated rows: counted for a campaign, and kept in a store."""

from __future__ import annotations

import hashlib
import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

from torch import Tensor

from sbi_active.messages import Explained
from sbi_active.simulation.outcomes import Outcome

if TYPE_CHECKING:
    from sbi_active.simulation.workers.schedule import Schedule


class RowStore(Protocol):
    """Keeps simulated rows across interruptions.

    All calls come from the process that simulates. Rows that are missing are not
    saved, so that a fault is tried again the next time.
    """

    def load(self, run: str) -> tuple[Tensor, Tensor, Tensor] | None:
        """Return the stored rows of a set, or None.

        Args:
            run: Digest of the set, see :func:`run_digest`.

        Returns:
            Row indices (k,), int64; x (k, *x_shape); status (k,).
        """
        ...

    def save(
        self,
        run: str,
        *,
        index: Tensor,
        theta: Tensor,
        action: Tensor,
        x: Tensor,
        status: Tensor,
        seed: int,
    ) -> None:
        """Store rows; they are on disk when this returns.

        Args:
            run: Digest of the set.
            index: Indices of these rows in the set, shape (k,), int64.
            theta: Parameters, shape (k, theta_dim).
            action: Actions, shape (k, action_dim).
            x: Outcomes, shape (k, *x_shape), float32.
            status: An :class:`.Outcome` a row, shape (k,), int8.
            seed: Seed of the whole set.
        """
        ...


def run_digest(seed: int, theta: Tensor, action: Tensor) -> str:
    """Return the name of a set of rows: SHA-256 of its seed, theta and action.

    Example:
        >>> import torch
        >>> theta = torch.zeros(2, 1)
        >>> run_digest(0, theta, theta)
        '40e5538b0077201874242ebaea9810a33215466f3dd244238daf0314374e325d'
    """
    shapes = tuple(theta.shape), tuple(action.shape)
    digest = hashlib.sha256(repr((int(seed), *shapes)).encode())
    for rows in (theta, action):
        digest.update(rows.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()


class Recorder:
    """Hands rows that are finished to a store, every half second.

    Args:
        store: Store of the rows, if any; the schedule takes what it has.
        schedule: Schedule of the rows.
    """

    INTERVAL = 0.5  # s

    def __init__(self, store: RowStore | None, schedule: Schedule) -> None:
        self._store, self._schedule = store, schedule
        if store is not None:
            self._run = run_digest(schedule.seed, schedule.theta, schedule.action)
            schedule.restore(store.load(self._run))
        self._last, self._is_stored = time.monotonic(), schedule.status >= 0

    def save(self, *, at_once: bool = False) -> None:
        """Store the rows that have finished since, if it is time."""
        is_due = at_once or time.monotonic() - self._last >= self.INTERVAL
        if self._store is None or not is_due:
            return
        rows, self._last = self._schedule, time.monotonic()
        is_new = (rows.status >= 0) & (rows.status < Outcome.MISSING)
        is_new &= ~self._is_stored
        self._is_stored |= is_new
        if rows.x is not None and bool(is_new.any()):
            self._store.save(
                self._run,
                index=is_new.nonzero()[:, 0],
                theta=rows.theta[is_new].detach().cpu(),
                action=rows.action[is_new].detach().cpu(),
                x=rows.x[is_new].detach().cpu(),
                status=rows.status[is_new],
                seed=rows.seed,
            )


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
    if block := _METER.get(None):
        block[0].spend(num_rows)


def find_store(simulator: Callable[..., Any]) -> RowStore | None:
    """Return the store of a simulator's rows, if the caller is in :func:`metering`."""
    block = _METER.get(None)
    return block and block[1](simulator)

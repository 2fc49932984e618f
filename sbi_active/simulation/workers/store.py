"""Interface of a store of rows, and the times when rows are handed to it."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TYPE_CHECKING, Any, Protocol, TypedDict

import torch
from torch import Tensor

if TYPE_CHECKING:
    from typing_extensions import Unpack


class StoredRows(TypedDict):
    """Rows of a set, as a store gets them.

    Attributes:
        index: Indices of these rows in the set, shape (k,), int64.
        theta: Parameters, shape (k, theta_dim).
        action: Actions, shape (k, action_dim).
        x: Outcomes, shape (k, *x_shape), float32.
        status: An :class:`.Outcome` a row, shape (k,), int8.
        seed: Seed of the whole set.
    """

    index: Tensor
    theta: Tensor
    action: Tensor
    x: Tensor
    status: Tensor
    seed: int


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

    def save(self, run: str, **rows: Unpack[StoredRows]) -> None:
        """Store rows; they are on disk when this returns.

        Args:
            run: Digest of the set.
            **rows: The rows, as keywords.
        """
        ...


#: Takes a simulator and returns the store of its rows, or None.
FindStore = Callable[[Callable[..., Any]], RowStore | None]

_FINDERS: ContextVar[FindStore | None] = ContextVar("stores", default=None)


@contextmanager
def storing(find: FindStore) -> Iterator[None]:
    """Have all simulations in the block stored that are given no store of their own.

    Args:
        find: Function that returns the store of a simulator's rows.
    """
    token = _FINDERS.set(find)
    try:
        yield
    finally:
        _FINDERS.reset(token)


def find_store(simulator: Callable[..., Any]) -> RowStore | None:
    """Return the store of a simulator's rows, if the caller is in :func:`storing`."""
    find = _FINDERS.get()
    return None if find is None else find(simulator)


def run_digest(seed: int, theta: Tensor, action: Tensor) -> str:
    """Return the name of a set of rows: SHA-256 of its seed, theta and action.

    Example:
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
    """Hands finished rows to a store, every half second or 4,096 rows."""

    INTERVAL = 0.5  # s
    CHUNK = 4096  # rows

    def __init__(
        self, store: RowStore, run: str, theta: Tensor, action: Tensor, seed: int
    ) -> None:
        self._store = store
        self._run = run
        self._theta = theta
        self._action = action
        self._seed = seed
        self._waiting: list[tuple[Tensor, Tensor, Tensor]] = []
        self._num_waiting = 0
        self._last = time.monotonic()

    def add(self, index: Tensor, x: Tensor, status: Tensor) -> None:
        """Take finished rows: index (k,), x (k, *x_shape), status (k,)."""
        self._waiting.append((index, x, status))
        self._num_waiting += len(index)
        is_due = time.monotonic() - self._last >= self.INTERVAL
        if is_due or self._num_waiting >= self.CHUNK:
            self.flush()

    def flush(self) -> None:
        """Store the rows that wait."""
        if self._waiting:
            index, x, status = map(torch.cat, zip(*self._waiting, strict=True))
            self._waiting, self._num_waiting = [], 0
            self._store.save(
                self._run,
                index=index,
                theta=self._theta[index].detach().cpu(),
                action=self._action[index].detach().cpu(),
                x=x.detach().cpu(),
                status=status,
                seed=self._seed,
            )
        self._last = time.monotonic()

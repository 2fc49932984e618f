"""Measured numbers of one or of several lengths, repeats, labels."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sbi_active.arrays import measured


def padded(value: Any) -> Tensor:
    """Return copies of arrays stacked, shorter ones padded with NaN at their end."""
    if _is_stacked(value):
        return measured(value)
    rows = [measured(np.nan if row is None else row) for row in value]
    if len({row.shape for row in rows}) <= 1:
        return torch.stack(rows) if rows else torch.empty(0)
    if len({row.shape[1:] for row in rows}) > 1 or any(r.ndim == 0 for r in rows):
        raise ValueError(
            "expected observations that differ in their first axis alone; got shapes "
            f"{[tuple(row.shape) for row in rows]}; give the same channels in each"
        )
    longest = max(len(row) for row in rows)
    x = torch.full((len(rows), longest, *rows[0].shape[1:]), torch.nan).double()
    for i, row in enumerate(rows):
        x[i, : len(row)] = row
    return x


def _is_stacked(value: Any) -> bool:
    if isinstance(value, np.ndarray) and value.dtype == object:
        return all(np.ndim(row) == 0 for row in value.flat)
    return isinstance(value, Tensor | np.ndarray) or bool(np.isscalar(value))


def repeated(action: Tensor) -> Tensor:
    """Return the position of the first trial of the same action, -1 for itself."""
    same = (action[:, None] == action[None]).all(-1)
    first = same.int().argmax(-1)
    return first.where(first != torch.arange(len(action)), torch.tensor(-1))


def root(repeat_of: Tensor) -> Tensor:
    """Return the first trial that each repeats, through repeats of repeats.

    Args:
        repeat_of: Position of the trial that each one repeats, shape (n,), -1 or its
            own for none.

    Returns:
        The same with positions that repeat nothing themselves, -1 for none.

    Raises:
        ValueError: If a position is no trial, or trials repeat each other in a circle.

    Example:
        >>> root(torch.tensor([-1, 0, 1, 3])).tolist()
        [-1, 0, 0, -1]
    """
    num = len(repeat_of)
    own = torch.arange(num)
    inside = (repeat_of >= -1) & (repeat_of < num) & (repeat_of == repeat_of.round())
    if not bool(inside.all()):
        raise ValueError(
            f"expected repeat_of among the positions 0 to {num - 1}, or -1 for none; "
            f"got {repeat_of.tolist()}; pass the position of the trial it repeats"
        )
    before = torch.where(repeat_of < 0, own, repeat_of.long())
    first = before
    for _ in range(num):
        first = before[first]
    if not bool((before[first] == first).all()):
        raise ValueError(
            "expected repeats that lead back to a first trial; got "
            f"{repeat_of.tolist()}, which runs in a circle; pass -1 for the first"
        )
    return first.where(first != own, torch.tensor(-1))


def require_names(names: Sequence[object] | None, num: int) -> tuple[str, ...] | None:
    """Return names of trials as text, or raise where they are not one each.

    Args:
        names: None for none.
        num: Number of trials.
    """
    if names is None:
        return None
    found = () if isinstance(names, str) else tuple(str(name).strip() for name in names)
    if len(found) != num or "" in found or len({*found}) < num:
        raise ValueError(
            f"expected names of {num} trials, each another; got {names!r}; name each "
            "trial, or leave names out"
        )
    return found


def require_labels(
    name: str, labels: Sequence[str] | None, sizes: Sequence[int]
) -> tuple[str, ...] | None:
    """Return labels as a tuple, or raise where they are not one text an entry.

    Args:
        name: Of the argument.
        labels: None for none.
        sizes: How many there may be.
    """
    if labels is None:
        return None
    found = () if isinstance(labels, str) else (*labels,)
    if len(found) not in sizes or not all(isinstance(each, str) for each in found):
        raise ValueError(
            f"expected {name} of {sizes[0]} strings, one an entry; got {labels!r}; "
            "pass a list of as many"
        )
    return found

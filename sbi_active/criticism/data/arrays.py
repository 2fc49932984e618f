"""Measured numbers of one or of several lengths, times, repeats, labels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from sbi_active.arrays import measured
from sbi_active.expected import require
from sbi_active.messages import warn

Role = Literal["fit", "held out"]


def padded(value: Any) -> Tensor:
    """Return copies of arrays stacked, shorter ones padded with NaN at their end."""
    if _is_stacked(value):
        return measured(value)
    rows = [measured(np.nan if row is None else row) for row in value]
    if len({row.shape for row in rows}) <= 1:
        return torch.stack(rows) if rows else torch.empty(0)
    require(
        len({row.shape[1:] for row in rows}) == 1 and all(r.ndim > 0 for r in rows),
        "observations that differ in their first axis alone",
        f"shapes {[tuple(row.shape) for row in rows]}",
        "give the same channels in each",
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


def kept(mask: Any, x: Tensor) -> Tensor:
    """Return where x is a measurement, of its shape; what pads a ragged mask is none.

    Args:
        mask: Mask as given, one an entry of x.
        x: Observations, shape (n, ...).
    """
    keep = padded(mask)
    if keep.ndim == 1 and x.shape[1:] == (1,):
        keep = keep[:, None]
    expected, got = f"a mask of shape {tuple(x.shape)}, that of x", tuple(keep.shape)
    require(keep.shape == x.shape, expected, got, "give one an entry of x")
    others = keep[(keep != 0) & (keep != 1) & ~keep.isnan()].tolist()
    got = ", ".join(f"{value:g}" for value in others[:1])
    advice = "pass True where x is a measurement"
    require(not others, "a mask of True and False, or 1 and 0", got, advice)
    return keep == 1


def without_inf(x: Tensor, names: Sequence[str]) -> Tensor:
    """Return x with NaN for inf, and say so: no sensor measures it."""
    lost = x.isinf().flatten(1).any(-1).nonzero()[:, 0].tolist()
    if lost:
        which = ", ".join(names[int(i)] for i in lost)
        warn(
            f"SA201 x is inf in trial{'s' * (len(lost) > 1)} {which}: taken as not "
            "measured, as NaN is",
        )
    return x.where(x.isfinite(), torch.nan)


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
        Positions that repeat nothing themselves, -1 for none.

    Raises:
        ValueError: If a position is no trial, or trials repeat each other in a circle.

    Example:
        >>> root(torch.tensor([-1, 0, 1, 3])).tolist()
        [-1, 0, 0, -1]
    """
    num = len(repeat_of)
    own = torch.arange(num)
    inside = (repeat_of >= -1) & (repeat_of < num) & (repeat_of == repeat_of.round())
    require(
        bool(inside.all()),
        f"repeat_of among the positions 0 to {num - 1}, or -1 for none",
        repeat_of.tolist(),
        "pass the position of the trial it repeats",
    )
    before = torch.where(repeat_of < 0, own, repeat_of.long())
    first = before
    for _ in range(num):
        first = before[first]
    got, advice = f"{repeat_of.tolist()}, which runs in a circle", "pass -1 for it"
    is_first = bool((before[first] == first).all())
    require(is_first, "repeats that lead back to a first trial", got, advice)
    return first.where(first != own, torch.tensor(-1))


def require_names(names: Sequence[object] | None, num: int) -> tuple[str, ...] | None:
    """Return names of trials as text, or raise where they are not one each.

    Args:
        names: Names of the trials; None for none.
        num: Number of trials.
    """
    if names is None:
        return None
    found = () if isinstance(names, str) else tuple(str(name).strip() for name in names)
    each = len({*found}) == len(found) == num and "" not in found
    expected = f"names of {num} trials, each another"
    require(each, expected, repr(names), "name each trial, or leave names out")
    return found


def require_labels(
    name: str, labels: Sequence[str] | None, sizes: Sequence[int]
) -> tuple[str, ...] | None:
    """Return labels as a tuple, or raise where they are not one text an entry.

    Args:
        name: Name of the argument.
        labels: Labels to check; None for none.
        sizes: Numbers of labels that are allowed.
    """
    if labels is None:
        return None
    found = () if isinstance(labels, str) else (*labels,)
    are = len(found) in sizes and all(isinstance(each, str) for each in found)
    expected = f"{name} of {sizes[0]} strings, one an entry"
    require(are, expected, repr(labels), "pass a list of as many")
    return found


def sample_times_of(times: Any, x: Tensor, names: Sequence[str]) -> Tensor | None:
    """Return sample times, shape (k,) or (n, k), or raise where they are no such.

    Args:
        times: Sample times as given; None for none.
        x: Observations, shape (n, k, ...), NaN where nothing was measured.
        names: Names of the n trials.
    """
    if times is None:
        return None
    tensor = padded(times)
    n, k = x.shape[:2]
    each, shape = "give one an entry of x's first axis", tuple(tensor.shape)
    expected = f"sample_times of shape ({k},) or ({n}, {k}) for x of {tuple(x.shape)}"
    require(shape in ((k,), (n, k)), expected, shape, each)
    has_x = x.isfinite().reshape(n, k, -1).any(-1)
    for stamps, has, name in zip(tensor.expand(n, k), has_x, names, strict=True):
        own = stamps[stamps.isfinite()]
        got = f"{len(own)} in trial {name}"
        known = bool((stamps.isfinite() | ~has).all())
        require(known, "a time of each sample in sample_times", got, each)
        got = f"{own.tolist()[:6]}... in trial {name}"
        increase = bool((own.diff() > 0).all())
        require(increase, "sample_times that increase", got, "sort its samples by time")
    return tensor


def start_states(start: Any, num: int) -> Tensor | dict[str, Tensor] | None:
    """Return measured start states, shape (num, d) or {name: (num,)}.

    Args:
        start: Start states as given; None for none.
        num: Number of trials.

    Raises:
        ValueError: If there is not one of finite numbers a trial.
    """
    if start is None:
        return None
    if not isinstance(start, Mapping):
        value = measured(start, name="start")
        return _starts(value[:, None] if value.ndim == 1 else value, num, 2, "start")
    named = {str(name): value for name, value in start.items()}
    return {name: _starts(value, num, 1, name) for name, value in named.items()}


def _starts(start: Any, num: int, ndim: int, name: str) -> Tensor:
    value = measured(start, name=name)
    expected = f"start states of shape ({num}, d), or {{name: ({num},)}}"
    is_one = value.ndim == ndim and len(value) == num
    require(is_one, expected, f"{tuple(value.shape)} of {name!r}", "give one a trial")
    lost = (~value.reshape(num, -1).isfinite().all(-1)).nonzero()[:, 0].tolist()
    got = f"{name!r} without a number in trials {lost}"
    advice = "leave these out, or declare the start as an effect of scope 'trial'"
    require(not lost, "finite start states", got, advice)
    return value


def rows_at(value: Any, at: Any) -> Any:
    """Return some rows of an array, or of each array of a dict; None stays None."""
    if isinstance(value, Mapping):
        return {name: part[at] for name, part in value.items()}
    return None if value is None else value[at]


def rows_joined(own: Any, further: Any) -> Any:
    """Return rows with further ones behind them, as :func:`rows_at` takes them."""
    if isinstance(own, Mapping):
        return {name: torch.cat([part, further[name]]) for name, part in own.items()}
    return None if own is None else torch.cat([own, further])


def roles_of(role: Sequence[Role] | None, n: int) -> list[Role]:
    """Return a role for each of n trials, "fit" where none is given."""
    given = ["fit"] * n if role is None else role
    roles: list[Any] = [str(each).replace("_", " ") for each in given]
    is_known = len(roles) == n and {*roles} <= {"fit", "held out"}
    expected = f"a role 'fit' or 'held out' for each of {n} trials"
    require(is_known, expected, roles, "give one each")
    return roles

"""Measured numbers of one or of several lengths, times, repeats, labels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
import torch
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from sbi_active.arrays import measured
from sbi_active.expected import require
from sbi_active.messages import warn

Role = Literal["fit", "held out"]


def padded(value: Any) -> Tensor:
    """Return copies of arrays stacked, shorter ones padded with NaN at their end."""
    is_array = isinstance(value, Tensor | np.ndarray) and value.dtype != object
    if is_array or np.isscalar(value):
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
    return pad_sequence(rows, batch_first=True, padding_value=torch.nan)


def kept(mask: Any, x: Tensor) -> Tensor:
    """Return where x is a measurement, of its shape; what pads a ragged mask is none.

    Args:
        mask: Mask as given, one an entry of x.
        x: Observations, shape (n, ...).
    """
    keep = padded(mask)
    if keep.ndim == 1 and x.shape[1:] == (1,):
        keep = keep[:, None]
    is_mask = bool(((keep == 0) | (keep == 1) | keep.isnan()).all())
    expected = f"a mask of True and False of shape {tuple(x.shape)}, that of x"
    got = f"{keep.flatten().tolist()[:6]} of shape {tuple(keep.shape)}"
    require(is_mask and keep.shape == x.shape, expected, got, "pass True where it is")
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


def one_each(name: str, value: Any, num: int, advice: str = "correct it") -> Tensor:
    """Return a finite number for each of some trials, shape (num,).

    Args:
        name: Name of the numbers.
        value: Numbers as given.
        num: Number of trials.
        advice: Advice on what to do where one is missing.
    """
    tensor = measured(value, name=name)
    expected, shape = f"{name} of shape ({num},), one a trial", tuple(tensor.shape)
    require(shape == (num,), expected, shape, "give one each")
    lost = (~tensor.isfinite()).nonzero()[:, 0].tolist()
    require(not lost, f"finite numbers in {name}", f"others in trials {lost}", advice)
    return tensor


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
        ValueError: If a position is no trial.

    Example:
        >>> root(torch.tensor([-1, 0, 1, 3])).tolist()
        [-1, 0, 0, -1]
    """
    num = len(repeat_of)
    inside = (repeat_of >= -1) & (repeat_of < num) & (repeat_of == repeat_of.round())
    expected = f"repeat_of among the positions 0 to {num - 1}, or -1 for none"
    advice = "pass the position of the trial it repeats"
    require(bool(inside.all()), expected, repeat_of.tolist(), advice)
    own = np.arange(num)
    of = np.where(repeat_of < 0, own, repeat_of.long())
    links = coo_array((np.ones(num), (own, of)), shape=(num, num))
    _, setting = connected_components(links, directed=False)
    return repeated(torch.from_numpy(setting)[:, None])


def texts(
    what: str,
    values: Sequence[object] | None,
    sizes: Sequence[int],
    *,
    distinct: bool = False,
) -> tuple[str, ...] | None:
    """Return names or labels as text, or raise where they are not one each.

    Args:
        what: What they are of, as in "names of 2 trials, each another".
        values: Names or labels; None for none.
        sizes: Numbers of them that are allowed.
        distinct: Whether each has to be another, and none empty.
    """
    if values is None:
        return None
    found = () if isinstance(values, str) else tuple(str(v).strip() for v in values)
    each = not distinct or len({*found} - {""}) == len(found)
    require(len(found) in sizes and each, what, repr(values), "pass a list of as many")
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
        is_known = bool((stamps.isfinite() | ~has).all() and (own.diff() > 0).all())
        got = f"{own.tolist()[:6]}... for {int(has.sum())} samples of trial {name}"
        expected = "sample_times that increase, one a sample"
        require(is_known, expected, got, "sort its samples by time")
    return tensor


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

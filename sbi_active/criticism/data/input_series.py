"""Inputs over time, as recorders give them, on one uniform grid for all trials."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal, get_args

import numpy as np
import torch
from torch import Tensor

from sbi_active.arrays import Array
from sbi_active.criticism.data.arrays import padded
from sbi_active.expected import require
from sbi_active.messages import warn

Hold = Literal["previous", "linear"]
#: Times and values of a series in a trial, of which the last may be missing.
Piece = tuple[Array, Array]

#: Median steps from which a step is a gap.
GAP = 5.0
#: Share of a trial's inputs by which its x may be measured before or after them.
FAR = 0.1
#: Relative difference of steps that are the same.
SAME = 1e-6
#: Share of a step by which a time may be off and count as that of a grid point.
ON_TIME = 1e-3


def inputs_of(
    inputs: Any,
    times: Any,
    x: Tensor,
    x_times: Tensor | None,
    names: Sequence[str],
    *,
    hold: Hold = "previous",
) -> tuple[dict[str, Tensor] | None, Tensor | None]:
    """Return the inputs of trials by name, shape (t, m), and their grid, shape (m,).

    Args:
        inputs: Inputs, as :func:`named_series` takes them; None for none.
        times: Times of the values, shape (m,), (t, m), or a list of t, or a dict of
            such by name; None takes those of x where there are as many.
        x: Observations that were measured, shape (t, k, ...).
        x_times: Times of x, shape (k,) or (t, k).
        names: Names of the trials.
        hold: Value between two times, as in :func:`on_one_grid`.

    Raises:
        ValueError: If those functions or :func:`require_covered` raise it.
    """
    given = "input_times alone"
    require(inputs is not None or times is None, "inputs", given, "pass inputs=")
    if inputs is None:
        return None, None
    series = _named_series(inputs, names)
    length = next(iter(series.values())).shape[1]
    if times is None and x_times is not None and x_times.shape[-1] == length:
        times = x_times
    require(
        times is not None,
        f"input_times, the time of each of {length} values of the inputs",
        "none",
        "pass them, in seconds from the origin of sample_times",
    )
    stamps = _stamps(series, times)
    grid = _on_one_grid(series, stamps, names, hold)
    if x_times is not None:
        has_x = x.isfinite().reshape(*x.shape[:2], -1).any(-1)
        measured = x_times.expand(has_x.shape).where(has_x, torch.nan)
        require_covered(measured, stamps, names)
    return grid


def _named_series(inputs: Any, names: Sequence[str]) -> dict[str, Tensor]:
    r"""Return inputs by name, each of shape (t, m), shorter ones padded with NaN.

    Args:
        inputs: {name: series}, each of shape (t, m), (m,) for one that all trials
            share, or a list of t arrays; without a name (t, m), (m,), (t, m, c) or a
            list, called "input", or "input 1" to "input c".
        names: Names of the trials.
    """
    if not isinstance(inputs, Mapping):
        value = padded(inputs)
        inputs = {"input": value}
        if value.ndim == 3 and value.shape[-1] > 1:
            inputs = {f"input {j + 1}": c for j, c in enumerate(value.unbind(-1))}
    is_named = bool(inputs) and all(isinstance(name, str) for name in inputs)
    require(is_named, "inputs as {name: series}", [*inputs], "name each input")
    found, num = {}, len(names)
    for name, value in inputs.items():
        own = padded(value)
        if own.ndim == 3 and own.shape[-1] == 1:
            own = own[..., 0]
        if own.ndim == 1 and len(own) > 1:
            own = own.expand(num, -1).clone()
        require(
            own.ndim == 2 and len(own) == num and own.shape[1] > 1,
            f"input {name!r} of shape ({num}, m), one series of two or more values a "
            f"trial, (m,) for one that all share, or a list of {num}",
            tuple(own.shape),
            "pass what does not vary in time as the action",
        )
        for i, k in own.isinf().nonzero().tolist():
            raise ValueError(
                f"expected finite values of input {name!r}; got inf in trial "
                f"{names[i]}, value {k}; correct it"
            )
        found[name] = own
    return found


def _on_one_grid(
    series: Mapping[str, Tensor],
    stamps: Mapping[str, Tensor],
    names: Sequence[str],
    hold: Hold,
) -> tuple[dict[str, Tensor], Tensor]:
    """Return series on one uniform grid, and the grid.

    Its step is the smallest median step of an input in a trial, and it reaches from the
    earliest to the latest time. Series on one uniform grid stay as they are. After a
    trial's end its last value is held, and before its start its first.

    Args:
        series: Series by name, shape (t, m), NaN after the last value of a trial.
        stamps: Times of the values, by name, shape (t, m), NaN where there are none.
        names: Names of the trials.
        hold: "previous" holds each value until the next one, as a command is held;
            "linear" draws lines between them.
    """
    known = "input_hold 'previous' or 'linear'"
    require(hold in get_args(Hold), known, repr(hold), "choose one")
    pieces = {
        name: [
            _piece(f"input {name!r} of trial {trial}", u, t)
            for trial, u, t in zip(names, value, stamps[name], strict=True)
        ]
        for name, value in series.items()
    }
    grid = _grid(pieces, names)
    found = {
        name: np.stack([_at(grid, t[: len(u)], u, hold) for t, u in each])
        for name, each in pieces.items()
    }
    held = {name: torch.from_numpy(value) for name, value in found.items()}
    return held, torch.from_numpy(grid)


def held_at(
    series: Mapping[str, Tensor], own: Tensor, times: Tensor
) -> dict[str, Tensor]:
    """Return series, each held until its next value, at the times of another grid.

    Args:
        series: Series by name, shape (t, m).
        own: Grid of the series, shape (m,).
        times: The other, shape (n,).
    """
    place = _held(own.numpy(), times.numpy(), float(own[1] - own[0]))
    return {name: value[:, place] for name, value in series.items()}


def _held(own: Array, times: Array, step: float) -> Array:
    """Return the place of the last value before each time.

    A value that rounding puts just after a time, by less than a thousandth step, is on
    time.
    """
    place = np.searchsorted(own, times + ON_TIME * step, side="right") - 1
    return np.clip(place, 0, len(own) - 1)


def require_covered(
    x_times: Tensor, stamps: Mapping[str, Tensor], names: Sequence[str]
) -> None:
    """Raise if x was measured long before or after an input of its trial.

    Args:
        x_times: Times of what was measured, shape (t, k), NaN for none.
        stamps: Times of the inputs, by name, shape (t, m).
        names: Names of the trials.
    """
    for name, own in stamps.items():
        for trial, row, times in zip(names, x_times, own, strict=True):
            known = times[times.isfinite()].numpy()
            steps, (first, last) = np.diff(known), (known.min(), known.max())
            step = np.median(steps) if len(steps) else 0.0
            slack = max(GAP * step, FAR * (last - first))
            for far in row[(row < first - slack) | (row > last + slack)][:1].tolist():
                raise ValueError(
                    f"expected x of trial {trial} measured within the time of its "
                    f"input {name!r}, {first:g} to {last:g}; got x at {far:g}; give "
                    "both in one unit and from one origin, or leave out what is beyond"
                )


def _stamps(series: Mapping[str, Tensor], times: Any) -> dict[str, Tensor]:
    """Return the times of each input's values, shape (t, m)."""
    of = times if isinstance(times, Mapping) else dict.fromkeys(series, times)
    expected, got = ", ".join(series), ", ".join(map(str, of)) or "none"
    advice = "give each input its own, or one array for all"
    require({*of} == {*series}, f"input_times of {expected}", f"those of {got}", advice)
    found = {}
    for name, value in series.items():
        own = padded(of[name])
        found[name] = own.expand(len(value), -1) if own.ndim == 1 else own
        shapes = f"({value.shape[1]},) or {tuple(value.shape)}"
        expected = f"input_times of shape {shapes} for input {name!r}"
        same = found[name].shape == value.shape
        require(same, expected, tuple(own.shape), "give one time a value")
    return found


def _piece(what: str, values: Tensor, times: Tensor) -> Piece:
    """Return times and values of a series without what pads them, or raise."""
    length, last = int(times.isfinite().sum()), int(values.isfinite().sum())
    for name, given, num in (("time", times, length), ("value", values, last)):
        for (k,) in (~given[:num].isfinite()).nonzero().tolist():  # else it is padding
            got = str(float(given[k])).replace("nan", "NaN")
            raise ValueError(
                f"expected a {name} of each value; got {got} for {what}, value {k}; "
                "fill it in"
            )
    t, u = times[:length].numpy(), values[:last].numpy()
    steps = np.diff(t)
    middle = float(np.median(steps)) if len(steps) else 0.0
    for k in np.flatnonzero(steps <= 0):
        raise ValueError(
            f"expected input_times that increase; got {t[k + 1]:g} after {t[k]:g} for "
            f"{what}, value {k + 1}; sort the values by time, and give each trial its "
            "own times"
        )
    for k in np.flatnonzero(steps > GAP * middle):
        raise ValueError(
            f"expected inputs without gaps; got no value from {t[k]:g} to {t[k + 1]:g} "
            f"for {what}, where the median step is {middle:g}; fill in what was "
            "commanded there, or split the trial"
        )
    got, advice = f"{last} values and {length} times of {what}", "action_* in a table"
    advice = f"pass what does not vary in time as the action, {advice}"
    is_series = 2 <= last <= length
    require(is_series, "two or more values, and the time of each", got, advice)
    return t, u


def _grid(pieces: Mapping[str, Sequence[Piece]], names: Sequence[str]) -> Array:
    """Return the grid; that of all series where it is uniform already."""
    every = [piece for each in pieces.values() for piece in each]
    first, _ = every[0]
    steps = np.diff(first)
    same = all(np.array_equal(t, first) and len(t) == len(u) for t, u in every)
    if same and (np.abs(steps - steps.mean()) <= SAME * steps.mean()).all():
        return first.copy()
    step = min(float(np.median(np.diff(t))) for t, _ in every)
    by_trial = zip(*pieces.values(), strict=True)
    ends = [(min(t[0] for t, _ in o), max(t[-1] for t, _ in o)) for o in by_trial]
    low, high = min(begin for begin, _ in ends), max(end for _, end in ends)
    _require_one_origin(ends, low, names)
    # Where the last time is between two steps, the grid goes up to the next.
    num = max(int(np.ceil((high - low) / step - ON_TIME)), 1)
    return low + step * np.arange(num + 1)


def _require_one_origin(
    ends: list[tuple[float, float]], low: float, names: Sequence[str]
) -> None:
    """Raise, or warn, where trials begin long after the grid: they hold what is first.

    Pieces of one record have its clock, and a simulator would run up to each.
    """
    late = [
        (name, begin - low, end - begin)
        for name, (begin, end) in zip(names, ends, strict=True)
        if begin - low > FAR * (end - begin)
    ]
    if not late:
        return
    name, after, span = max(late, key=lambda each: each[1] / each[2])
    remedy = "give the times of each trial, those of x too, from its own begin"
    if after > span:
        raise ValueError(
            "expected trials that begin at similar times; got trial "
            f"{name} of {span:g} that begins {after:g} after the earliest; {remedy}, "
            "and all in one unit"
        )
    warn(
        f"SA208 trials {', '.join(each[0] for each in late)} begin up to {after:g} "
        "after the earliest, and hold their first inputs until then: "
        f"{remedy} where a simulator starts there",
    )


def _at(grid: Array, times: Array, values: Array, hold: Hold) -> Array:
    """Return a series at the grid's times."""
    if hold == "linear":
        return np.interp(grid, times, values)
    return values[_held(times, grid, grid[1] - grid[0])]

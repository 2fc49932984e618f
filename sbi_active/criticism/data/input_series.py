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
    hold: Hold,
    x: Tensor,
    x_times: Tensor | None,
    names: Sequence[str],
) -> tuple[dict[str, Tensor] | None, Tensor | None]:
    """Return the inputs of trials by name, shape (t, m), and their grid, shape (m,).

    The step of the grid is the smallest median step of an input in a trial, and it
    reaches from the earliest to the latest time. Series on one uniform grid stay as
    they are. After a trial's end its last value is held, and before its start its
    first.

    Args:
        inputs: {name: series}, each of shape (t, m), (m,) for one that all trials
            share, or a list of t arrays; None for none.
        times: Times of the values, shape (m,), (t, m), or a list of t, or a dict of
            such by name; None takes those of x where there are as many.
        hold: "previous" holds each value until the next one, as a command is held;
            "linear" draws lines between them.
        x: Observations that were measured, shape (t, k, ...).
        x_times: Times of x, shape (k,) or (t, k).
        names: Names of the trials.

    Raises:
        ValueError: If series are none of these, have no times or gaps, begin at very
            different times, or :func:`require_covered` raises it.
    """
    if inputs is None:
        require(times is None, "inputs", "input_times alone", "pass inputs=")
        return None, None
    names_of = [*inputs] if isinstance(inputs, Mapping) else []
    is_named = bool(names_of) and all(isinstance(name, str) for name in names_of)
    got = names_of or type(inputs)
    require(is_named, "inputs as {name: series}", got, "name each input")
    known = "input_hold 'previous' or 'linear'"
    require(hold in get_args(Hold), known, repr(hold), "choose one")
    of = times if isinstance(times, Mapping) else dict.fromkeys(inputs, times)
    expected, got = f"input_times of {', '.join(inputs)}", f"those of {', '.join(of)}"
    advice = "give each input its own, or one array for all"
    require({*of} == {*inputs}, expected, got, advice)
    pieces: dict[str, list[Piece]] = {}
    stamps, num = dict[str, Tensor](), len(names)
    for name, value in inputs.items():
        own = padded(value)
        own = own.expand(num, -1) if own.ndim == 1 and len(own) > 1 else own
        shape = tuple(own.shape)
        require(
            own.ndim == 2 and len(own) == num and shape[1] > 1,
            f"input {name!r} of shape ({num}, m), one series of two or more values a "
            f"trial, (m,) for one that all share, or a list of {num}",
            shape,
            "pass what does not vary in time as the action",
        )
        when = x_times if of[name] is None else padded(of[name])
        got = "none" if when is None else tuple(when.shape)
        expected = f"input_times of input {name!r}, of shape {shape[1:]} or {shape}"
        advice = "pass them, in seconds from the origin of sample_times"
        is_each = when is not None and when.shape in (own.shape[1:], own.shape)
        require(is_each, expected, got, advice)
        stamps[name] = torch.as_tensor(when).expand(shape)
        pieces[name] = [
            _piece(f"input {name!r} of trial {trial}", u, t)
            for trial, u, t in zip(names, own, stamps[name], strict=True)
        ]
    grid = _grid(pieces, names)
    found = {
        name: torch.from_numpy(np.stack([_at(grid, *piece, hold) for piece in each]))
        for name, each in pieces.items()
    }
    if x_times is not None:
        has_x = x.isfinite().reshape(*x.shape[:2], -1).any(-1)
        measured = x_times.expand(has_x.shape).where(has_x, torch.nan)
        require_covered(measured, stamps, names)
    return found, torch.from_numpy(grid)


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
            step, first, last = np.median(np.diff(known)), known.min(), known.max()
            slack = max(GAP * step, FAR * (last - first))
            for far in row[(row < first - slack) | (row > last + slack)][:1].tolist():
                raise ValueError(
                    f"expected x of trial {trial} measured within the time of its "
                    f"input {name!r}, {first:g} to {last:g}; got x at {far:g}; give "
                    "both in one unit and from one origin, or leave out what is beyond"
                )


def _piece(what: str, values: Tensor, times: Tensor) -> Piece:
    """Return times and values of a series without what pads them, or raise."""
    length, last = int((~times.isnan()).sum()), int((~values.isnan()).sum())
    t, u = times[:length].numpy(), values[:last].numpy()
    for name, given in (("time", t), ("value", u)):
        for k in np.flatnonzero(~np.isfinite(given)):  # else it is padding
            raise ValueError(
                f"expected a {name} of each value; got {given[k]} for {what}, value "
                f"{k}; fill it in"
            )
    is_series = 2 <= last <= length
    got, expected = f"{last} values and {length} times of {what}", "two or more values"
    advice = "pass what does not vary in time as the action, action_* in a table"
    require(is_series, f"{expected}, and the time of each", got, advice)
    steps = np.diff(t)
    k, widest, middle = int(np.argmin(steps)), int(np.argmax(steps)), np.median(steps)
    got = f"{t[k + 1]:g} after {t[k]:g} for {what}, value {k + 1}"
    advice = "sort the values by time, and give each trial its own times"
    require(bool(steps[k] > 0), "input_times that increase", got, advice)
    got = f"no value from {t[widest]:g} to {t[widest + 1]:g} for {what}, where the "
    got += f"median step is {middle:g}"
    advice = "fill in what was commanded there, or split the trial"
    has_no_gap = bool(steps[widest] <= GAP * middle)
    require(has_no_gap, "inputs without gaps", got, advice)
    return t, u


def _grid(pieces: Mapping[str, Sequence[Piece]], names: Sequence[str]) -> Array:
    """Return the grid; that of all series where it is uniform already.

    Raises, or warns, where trials begin long after it: they hold what is first.
    """
    every = [piece for each in pieces.values() for piece in each]
    first, _ = every[0]
    steps = np.diff(first)
    same = all(np.array_equal(t, first) and len(t) == len(u) for t, u in every)
    if same and (np.abs(steps - steps.mean()) <= SAME * steps.mean()).all():
        return first.copy()
    step = min(float(np.median(np.diff(t))) for t, _ in every)
    begin = np.min([[t[0] for t, _ in each] for each in pieces.values()], axis=0)
    end = np.max([[t[-1] for t, _ in each] for each in pieces.values()], axis=0)
    low, high = begin.min(), end.max()
    # Pieces of one record have its clock, and a simulator would run up to each.
    after, span = begin - low, end - begin
    k = int(np.argmax(after / span))
    got = f"trial {names[k]}, which lasts {span[k]:g} and begins {after[k]:g} after "
    got += "the earliest"
    remedy = "give the times of each trial, those of x too, from its own begin"
    is_near, expected = after[k] <= span[k], "trials that begin at similar times"
    require(is_near, expected, got, f"{remedy}, and all in one unit")
    if after[k] > FAR * span[k]:
        warn(
            f"SA208 {got}, holds its first input until then: {remedy} where a "
            "simulator starts there",
        )
    # Where the last time is between two steps, the grid goes up to the next.
    num = max(int(np.ceil((high - low) / step - ON_TIME)), 1)
    return low + step * np.arange(num + 1)


def _at(grid: Array, times: Array, values: Array, hold: Hold) -> Array:
    """Return a series at the grid's times."""
    times = times[: len(values)]
    if hold == "linear":
        return np.interp(grid, times, values)
    return values[_held(times, grid, grid[1] - grid[0])]

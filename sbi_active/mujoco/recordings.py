"""Logs of a robot as trials: columns are called as actuators and sensors are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sbi_active.arrays import Array
from sbi_active.criticism.data.cells import Cells, read_csv
from sbi_active.criticism.data.columns import (
    TIME,
    TRIAL,
    Column,
    find_columns,
    split,
    to_si,
)
from sbi_active.criticism.data.tables import (
    arguments_of,
    find_recordings,
    headers_of,
)
from sbi_active.criticism.data.trials import Trials
from sbi_active.expected import require
from sbi_active.messages import warn
from sbi_active.mujoco.models.names import (
    names_of,
    places_of,
    require_name,
    scalar_joints,
)
from sbi_active.mujoco.simulator import Channel

START = "start "
#: Relative excess over a range that is rounding.
SLACK = 1e-6
#: Time steps between two samples, beyond which a log looks like one in ms: a sample
#: every 2 s at MuJoCo's default step; a log at 50 Hz in ms has ten times as many.
MOST_APART = 1_000
#: Time steps before the first sample, beyond which a time is one of a clock.
MOST_STEPS = 1e7
#: Times a joint's range, beyond which an angle looks like degrees, 57 times a radian.
DEGREES = 10.0


def trials_of(
    model: Any,
    recordings: Any,
    channels: Sequence[Channel],
    *,
    inputs: Sequence[str],
) -> Trials:
    """Return logs as trials.

    Each log has a column "time", s from the start of the trial, one for each input and
    one for each sensor, and may have "start hinge" or "start hinge velocity", the same
    in each row. All logs have the same columns. If a sensor has the name of an input,
    the input's column is "hinge control". A sensor may have NaN where it was not read,
    and an input where the one before holds. A unit in brackets, as in "hinge [deg]" or
    "time [ms]", is converted.

    Args:
        model: Compiled model.
        recordings: A list of data frames, of dicts of arrays, of paths of CSV files or
            of folders of such; or one of these.
        channels: Channels that the simulator returns.
        inputs: Actuators that are driven.

    Raises:
        ValueError: If a column is missing, not known or in a unit that cannot be
            converted, the time does not increase, or a control is outside its range.
    """
    if isinstance(recordings, pd.DataFrame | Mapping | str | Path):
        recordings = [recordings]
    logs: list[Any] = []
    for given in recordings:
        is_folder = isinstance(given, str | Path) and Path(given).is_dir()
        logs += find_recordings(Path(given)) if is_folder else [given]
    require(bool(logs), "at least one recording", "none", "pass logs")
    parts = {}
    for k, log in enumerate(logs):
        is_file = isinstance(log, str | Path)
        what = f"recording {k} ({log})" if is_file else f"recording {k}"
        frame = read_csv(Path(log)) if is_file else pd.DataFrame(log)
        require(len(frame) > 0, f"samples in {what}", "no rows", "record some")
        header = [str(name).strip() for name in frame]
        parts[what] = frame.set_axis(header, axis=1).assign(**{TRIAL: str(k)})
    columns = _columns(model, headers_of(parts), channels, inputs)
    cells = Cells(parts, columns, "the recordings")
    found, step = arguments_of(cells), float(model.opt.timestep)
    numbers = [cells.numbers(column, empty=True) for column in columns["x"]]
    for what, at in zip(parts, cells.members, strict=True):
        require_seconds(cells.time[at], step, what)
        _note_spacing(cells.time[at], step, what)
        for channel, values in zip(channels, numbers, strict=True):
            _note_angles(model, channel, values[at], what)
    for column in columns["input"]:
        values = cells.numbers(column, empty=True)
        require_in_range(model, column.name, values, "the recordings")
    times = found.pop("sample_times")
    same = all(np.array_equal(each, times[0]) for each in times)
    return Trials(**{**found, "names": None}, sample_times=times[0] if same else times)


def require_in_range(model: Any, name: str, values: Array, what: str) -> None:
    """Raise if a control is outside the range that its actuator has.

    MuJoCo would clip it without a warning.

    Args:
        model: Compiled model.
        name: Name of the actuator.
        values: Values of the control, of any shape.
        what: Source of the values, for the error.
    """
    i = names_of(model, "actuator").index(name)
    if not model.actuator_ctrllimited[i]:
        return
    low, high = (float(v) for v in model.actuator_ctrlrange[i])
    slack = SLACK * (high - low)
    lowest, highest = float(np.nanmin(values)), float(np.nanmax(values))
    require(
        low - slack <= lowest and highest <= high + slack,
        f"controls of {name!r} within its ctrlrange, {low:g} to {high:g}",
        f"{lowest:g} to {highest:g} in {what}",
        "correct the unit, or the range in the MJCF",
    )


def _columns(
    model: Any,
    headers: Sequence[str],
    channels: Sequence[Channel],
    inputs: Sequence[str],
) -> dict[str, list[Column]]:
    """Return the columns of logs that a model takes."""
    units = {TIME: "s", **{channel.name: channel.unit for channel in channels}}
    names, own = [channel.name for channel in channels], [split(c)[0] for c in headers]
    starts = [START + name for name in places_of(model)]
    for name in own:
        if name.startswith(START):
            require_name(name, starts, "start state")
    # A column that an input shares with a sensor is the sensor's.
    controls = {name: f"{name} control" for name in inputs}
    is_other = {name: name in names or controls[name] in own for name in inputs}
    columns = {
        TRIAL: TRIAL,
        TIME: TIME,
        "x": names,
        "input": [controls[name] if is_other[name] else name for name in inputs],
        "start": [name for name in starts if name in own],
    }
    found = find_columns(headers, columns=columns, source="the recordings")
    for column in chain(*found.values()):
        name, told = split(column.header)
        expected = units.get(name, "")
        is_known = not told or (to_si(told) and expected in ("", column.unit))
        require(
            bool(is_known),
            f"{name!r} in {expected or 'a unit of SI'}",
            f"[{told}] in the recordings",
            "convert the numbers, or leave their unit out",
        )
    # From here on they are called as the model's own.
    each = zip(found["x"], channels, strict=True)
    called = zip(found["input"], inputs, strict=True)
    starting = ((c, c.name.removeprefix(START)) for c in found["start"])
    return found | {
        "x": [replace(c, name=own.name, unit=own.unit) for c, own in each],
        "input": [replace(c, name=name) for c, name in called],
        "start": [replace(c, name=name) for c, name in starting],
    }


def require_seconds(time: Array, step: float, what: str) -> None:
    """Raise where times can hardly be seconds from the start of a trial.

    Args:
        time: Times, shape (k,).
        step: Time step of the model, s.
        what: Name of the times in messages.
    """
    increase = time.ndim == 1 and len(time) > 0 and bool((np.diff(time) > 0).all())
    require(
        increase and 0 <= time[0] <= MOST_STEPS * step,
        f"times in {what} that increase from the start of the trial, s",
        np.array2string(time, threshold=6),
        "subtract the time at which the trial starts",
    )


def _note_spacing(time: Array, step: float, what: str) -> None:
    """Warn of samples that are as far apart as those of a log in ms."""
    spacing = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    if spacing > MOST_APART * step:
        warn(
            f"SA204 {what} has a sample every {spacing:g} s, {spacing / step:,.0f} "
            f"time steps of {step:g} s, and asks for {time[-1] / step:,.0f} steps: is "
            "its time in ms? Convert it to seconds, or raise the time step",
        )


def _note_angles(model: Any, channel: Channel, x: Array, what: str) -> None:
    """Warn of angles that wrap, or that look like degrees.

    Args:
        model: Compiled model.
        channel: Channel that was read; angles are those in rad.
        x: Readings, shape (k,).
        what: Name of the log in messages.
    """
    seen = x[np.isfinite(x)]
    if channel.unit != "rad" or len(seen) < 2:
        return
    jumps = np.abs(np.diff(seen))
    wraps = np.abs(jumps - 2 * np.pi) < 0.1 * 2 * np.pi
    if wraps.any() and np.median(jumps) < 0.2 * 2 * np.pi:
        warn(
            f"SA205 {channel.name} in {what} jumps by about 2 pi in {int(wraps.sum())} "
            "places, as an angle that wraps: pass numpy.unwrap of it",
        )
    joint = scalar_joints(model).get(channel.name)
    if joint is not None:
        limit = float(np.abs(model.jnt_range[joint]).max())
        if model.jnt_limited[joint] and np.abs(seen).max() > DEGREES * limit:
            warn(
                f"SA206 {channel.name} in {what} reaches {np.abs(seen).max():g}, "
                f"where its joint's range ends at {limit:g} rad: are these degrees? "
                "Convert them",
            )

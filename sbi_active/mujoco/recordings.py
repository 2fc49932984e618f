"""Logs of a robot as trials: columns are called as actuators and sensors are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sbi_active.arrays import Array
from sbi_active.criticism.data.columns import (
    TIME,
    TRIAL,
    Column,
    find_columns,
    require_named,
    split,
    to_si,
)
from sbi_active.criticism.data.files import find_recordings, read_csv
from sbi_active.criticism.data.tables import Table, arguments_of, headed
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
        frame = read_csv(Path(log)) if is_file else pd.DataFrame(log)
        name = f"recording {k} ({log})" if is_file else f"recording {k}"
        parts[name] = frame.assign(**{TRIAL: str(k)})
    parts, headers = headed(parts)
    columns = _columns(model, headers, channels, inputs)
    table = Table(parts, columns, "the recordings")
    found, step = arguments_of(table), float(model.opt.timestep)
    for what, rows in table.frame.groupby(level="file", sort=False):
        time = rows[TIME].to_numpy()
        require_seconds(time, step, str(what))
        _note_spacing(time, step, str(what))
        for channel, column in zip(channels, table.of("x"), strict=True):
            _note_angles(model, channel, rows[column].to_numpy(), str(what))
    for column in table.of("input"):
        values = table.frame[column].to_numpy()
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
) -> list[Column]:
    """Return the columns of logs that a model takes, called as it calls them."""
    sensors, own = (
        [channel.name for channel in channels],
        [split(c)[0] for c in headers],
    )
    places = {START + name: name for name in places_of(model)}
    starts = [name for name in own if name.startswith(START)]
    for name in starts:
        require_name(name, places, "start state")
    # A column that an input shares with a sensor is the sensor's.
    driven = {
        f"{name} control" if name in sensors or f"{name} control" in own else name: name
        for name in inputs
    }
    told = {TRIAL: TRIAL, TIME: TIME, "x": sensors, "input": [*driven], "start": starts}
    require_named([TIME, *sensors, *driven], headers, "the recordings")
    units = {TIME: "s", **{channel.name: channel.unit for channel in channels}}
    found = []
    for column in find_columns(headers, told, None, "the recordings"):
        name, unit = split(column.header)
        expected = units.get(name, "")
        require(
            not unit or bool(to_si(unit) and expected in ("", column.unit)),
            f"{name!r} in {expected or 'a unit of SI'}",
            f"[{unit}] in the recordings",
            "convert the numbers, or leave their unit out",
        )
        name = {**places, **driven}.get(name, name)
        found.append(replace(column, name=name, unit=column.unit or expected))
    return found


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

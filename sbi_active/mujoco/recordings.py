"""Logs of a robot as trials: columns are called as actuators and sensors are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sbi_active.arrays import Array
from sbi_active.criticism.data.cells import Cells, read_csv
from sbi_active.criticism.data.columns import find_columns
from sbi_active.criticism.data.tables import find_recordings
from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.data.units import TIME, split, to_si
from sbi_active.expected import did_you_mean, require
from sbi_active.messages import warn
from sbi_active.mujoco.models.names import names_of, places_of, scalar_joints
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
    one for each sensor, and may have "start hinge" or "start hinge velocity", of which
    the first row counts. If a sensor has the name of an input, the input's column is
    "hinge control". A sensor may have NaN where it was not read; an input is held. A
    unit in brackets, as in "hinge [deg]" or "time [ms]", is converted.

    Args:
        model: Compiled model.
        recordings: A list of data frames, of dicts of arrays, of paths of CSV files or
            of folders of such; or one of these.
        channels: Channels that the simulator returns.
        inputs: Actuators that are driven.

    Raises:
        ValueError: If a column is missing, not known or in a unit that cannot be
            converted, the time does not increase, an input is NaN, or a control is
            outside its range.
    """
    if isinstance(recordings, pd.DataFrame | Mapping | str | Path):
        recordings = [recordings]
    logs: list[Any] = []
    for given in recordings:
        is_folder = isinstance(given, str | Path) and Path(given).is_dir()
        logs += find_recordings(Path(given)) if is_folder else [given]
    require(bool(logs), "at least one recording", "none", "pass logs")
    cells = [
        _cells(model, f"recording {k}", log, channels, inputs)
        for k, log in enumerate(logs)
    ]
    times, x, series = [], [], {name: [] for name in inputs}
    starts = {column.name: [] for column in cells[0].columns["start"]}
    step = float(model.opt.timestep)
    for log in cells:
        require_seconds(log.time, step, log.source)
        _note_spacing(log.time, step, log.source)
        times.append(log.time)
        values = [log.numbers(column, empty=True) for column in log.columns["x"]]
        for channel, column in zip(channels, values, strict=True):
            _note_angles(model, channel, column, log.source)
        x.append(values[0] if len(channels) == 1 else np.stack(values, 1))
        for name, column in zip(inputs, log.columns["input"], strict=True):
            series[name].append(log.numbers(column))
            require_in_range(model, name, series[name][-1], log.source)
        own = [column.name for column in log.columns["start"]]
        got = f"{', '.join(own) or 'none'} in {log.source} beside "
        got += f"{', '.join(starts) or 'none'} in {cells[0].source}"
        expected = "the same start states in each recording"
        require(own == [*starts], expected, got, "add them to each")
        for column in log.columns["start"]:
            first = float(log.numbers(column, empty=True)[0])
            expected = f"{column.name} in the first row of {log.source}"
            require(np.isfinite(first), expected, "an empty cell", "fill it in")
            starts[column.name].append(first)
    same = all(np.array_equal(time, times[0]) for time in times)
    return Trials(
        None,
        x,
        sample_times=times[0] if same else times,
        inputs=series or None,
        input_times=times if inputs else None,
        start={name.removeprefix(START): own for name, own in starts.items()} or None,
        channel_labels=[channel.label for channel in channels],
    )


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


def _cells(
    model: Any,
    what: str,
    given: Any,
    channels: Sequence[Channel],
    inputs: Sequence[str],
) -> Cells:
    """Return the columns of a log that a model takes, in SI."""
    if isinstance(given, str | Path):
        what = f"{what} ({given})"
        given = read_csv(Path(given))
    frame = pd.DataFrame(given)
    require(len(frame) > 0, f"samples in {what}", "no rows", "record some")
    frame.columns = [str(c).strip() for c in frame.columns]
    units = {TIME: "s", **{channel.name: channel.unit for channel in channels}}
    names, own = [channel.name for channel in channels], [split(c)[0] for c in frame]
    starts = [START + name for name in places_of(model)]
    for name in own:
        require(
            not name.startswith(START) or name in starts,
            f"start states of joints in {what}",
            repr(name),
            did_you_mean(name, starts, f"did you mean {starts[0]!r}?"),
        )
    # A column that an input shares with a sensor is the sensor's.
    controls = {name: f"{name} control" for name in inputs}
    is_other = {name: name in names or controls[name] in own for name in inputs}
    columns = {
        TIME: TIME,
        "x": names,
        "input": [controls[name] if is_other[name] else name for name in inputs],
        "start": [name for name in starts if name in own],
    }
    found = find_columns([*frame.columns], columns=columns, source=what)
    for column in chain(*found.values()):
        name, told = split(column.header)
        expected = units.get(name, "")
        is_known = not told or (to_si(told) and expected in ("", column.unit))
        require(
            bool(is_known),
            f"{name!r} in {expected or 'a unit of SI'}",
            f"[{told}] in {what}",
            "convert the numbers, or leave their unit out",
        )
    return Cells({what: frame}, found, what)


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
    for turn, unit in ((2 * np.pi, "2 pi"), (360.0, "360")):
        wraps = np.abs(jumps - turn) < 0.1 * turn
        if wraps.any() and np.median(jumps) < 0.2 * turn:
            warn(
                f"SA205 {channel.name} in {what} jumps by about {unit} in "
                f"{int(wraps.sum())} places, as an angle that wraps: pass "
                "numpy.unwrap of it",
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

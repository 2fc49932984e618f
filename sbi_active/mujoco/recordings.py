"""Logs of a robot as trials: columns are called as actuators and sensors are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sbi_active.arrays import Array
from sbi_active.callers import stack_level
from sbi_active.criticism.data.recordings import find_recordings
from sbi_active.criticism.data.table_rows import (
    is_stamp,
    read_csv,
    require_real,
    seconds,
)
from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.data.units import TIME, split, to_si
from sbi_active.expected import did_you_mean
from sbi_active.messages import warn
from sbi_active.mujoco.models.names import held_places, names_of, start_places
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
    if not len(recordings):
        raise ValueError("expected at least one recording; got none; pass logs")
    names = [c.name for c in channels]
    logs = [log for given in recordings for log in _logs(given)]
    frames = [_frame(model, k, log, channels, inputs) for k, log in enumerate(logs)]
    times = [frame[TIME].to_numpy(float) for frame in frames]
    x = [frame[names].to_numpy(float) for frame in frames]
    for k, values in enumerate(x):
        for channel, own in zip(channels, values.T, strict=True):
            _note_angles(model, channel, own, f"recording {k}")
    if len(names) == 1:
        x = [part[:, 0] for part in x]
    same = all(t.shape == times[0].shape and (t == times[0]).all() for t in times)
    starts = [c for c in frames[0].columns if c.startswith(START)]
    return Trials(
        None,
        x,
        sample_times=times[0] if same else times,
        inputs={
            name: [f[_column(name, f, names)].to_numpy(float) for f in frames]
            for name in inputs
        }
        or None,
        input_times=times if inputs else None,
        start={
            c.removeprefix(START): [float(f[c].iloc[0]) for f in frames] for c in starts
        }
        or None,
        channel_labels=[f"{c.name} [{c.unit}]" if c.unit else c.name for c in channels],
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
    if lowest < low - slack or highest > high + slack:
        raise ValueError(
            f"expected controls of {name!r} within its ctrlrange, {low:g} to {high:g}; "
            f"got {lowest:g} to {highest:g} in {what}; correct the unit, or the range "
            "in the MJCF"
        )


def _logs(given: Any) -> Sequence[Any]:
    """Return a log, or the files of a folder of logs."""
    is_folder = isinstance(given, str | Path) and Path(given).is_dir()
    return find_recordings(Path(given)) if is_folder else [given]


def _frame(
    model: Any, k: int, given: Any, channels: Sequence[Channel], inputs: Sequence[str]
) -> pd.DataFrame:
    """Return a log whose columns are as they should be, in SI."""
    names = [channel.name for channel in channels]
    what = f"recording {k}"
    if isinstance(given, str | Path):
        what = f"{what} ({given})"
        given = read_csv(Path(given))
    frame = pd.DataFrame(given)
    units = dict(split(str(c).strip()) for c in frame.columns)
    if len(units) < len(frame.columns):
        raise ValueError(
            f"expected each column once in {what}; got {', '.join(frame.columns)}; "
            "keep one"
        )
    frame.columns = [*units]
    starts = [START + name for name in (*start_places(model), *held_places(model))]
    controls = [_column(name, frame, names) for name in inputs]
    wanted = [TIME, *controls, *names]
    spare = [c for c in frame.columns if c not in {*wanted, *starts}]
    for name in wanted:
        if name not in frame.columns:
            hint = did_you_mean(name, spare, "rename or add it")
            raise ValueError(
                f"expected a column {name!r} in {what}; got {', '.join(frame.columns)};"
                f" {hint}"
            )
    for name in spare:
        if name.startswith(START):
            hint = did_you_mean(name, starts, f"did you mean {starts[0]!r}?")
            raise ValueError(
                f"expected start states of joints in {what}; got {name!r}; {hint}"
            )
    used = wanted + [c for c in frame if c in starts]
    known = {TIME: "s", **{channel.name: channel.unit for channel in channels}}
    scales = {c: _factor(c, units[c], known.get(c, ""), what) for c in used}
    frame = _as_numbers(frame, scales, what)
    for name in [TIME, *controls]:
        lost = np.flatnonzero(~np.isfinite(frame[name].to_numpy(float)))
        if len(lost):
            raise ValueError(
                f"expected finite {name!r} in {what}; got NaN or inf in row {lost[0]}; "
                "fill in what was commanded, or cut the log there"
            )
    if (np.diff(frame[TIME].to_numpy(float)) <= 0).any():
        row = int(np.flatnonzero(np.diff(frame[TIME].to_numpy(float)) <= 0)[0]) + 1
        raise ValueError(
            f"expected a time that increases in {what}; got {frame[TIME][row]:g} in "
            f"row {row}; sort the log, and split it where it starts again"
        )
    _require_seconds(frame[TIME].to_numpy(float), float(model.opt.timestep), what)
    for name, column in zip(inputs, controls, strict=True):
        require_in_range(model, name, frame[column].to_numpy(float), what)
    return frame


def _factor(name: str, unit: str, expected: str, what: str) -> float:
    """Return the factor from the unit of a log's header to that of the model."""
    if not unit:
        return 1.0
    factor, si = to_si(unit) or (1.0, "")
    if not si or (expected and si != expected):
        raise ValueError(
            f"expected {name!r} in {expected or 'a unit of SI'}; got [{unit}] in "
            f"{what}; convert the numbers, or leave their unit out"
        )
    return factor


def _as_numbers(
    frame: pd.DataFrame, scales: Mapping[str, float], what: str
) -> pd.DataFrame:
    """Return a log whose columns are numbers, dates as seconds since the first.

    Args:
        frame: The log.
        scales: Factor of each column that is used.
        what: Name of the log in messages.
    """
    frame = frame.copy()
    for name, scale in scales.items():
        cells: Any = frame[name]
        if name == TIME and is_stamp(cells):
            frame[name] = seconds(cells, what)
            continue
        require_real(cells, name, what)
        blank = cells.map(lambda cell: str(cell).strip() == "")
        numbers: Any = pd.to_numeric(cells.where(~blank), errors="coerce")
        wrong = np.flatnonzero(numbers.isna() & cells.notna() & ~blank)
        if len(wrong) and str(cells.iloc[wrong[0]]).strip().lower() != "nan":
            raise ValueError(
                f"expected numbers in column {name!r} of {what}; got "
                f"{cells.iloc[wrong[0]]!r} in row {wrong[0]}; correct it, or leave "
                "what was not read empty"
            )
        frame[name] = numbers * scale
    return frame


def _require_seconds(time: Array, step: float, what: str) -> None:
    """Raise or warn where times can hardly be seconds from the start of a trial.

    Args:
        time: Times of a log, which increase, shape (k,).
        step: Time step of the model, s.
        what: Name of the log in messages.
    """
    if len(time) and (time[0] < 0 or time[0] > MOST_STEPS * step):
        raise ValueError(
            f"expected times from the start of the trial in {what}; got {time[0]:g} s "
            "at first; subtract the time at which the trial starts"
        )
    spacing = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    if spacing > MOST_APART * step:
        warn(
            f"SA204 {what} has a sample every {spacing:g} s, {spacing / step:,.0f} "
            f"time steps of {step:g} s, and asks for {time[-1] / step:,.0f} steps: is "
            "its time in ms? Convert it to seconds, or raise the time step",
            stacklevel=stack_level(),
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
                stacklevel=stack_level(),
            )
    names = names_of(model, "joint")
    if channel.name in names:
        joint = names.index(channel.name)
        limit = float(np.abs(model.jnt_range[joint]).max())
        if model.jnt_limited[joint] and np.abs(seen).max() > DEGREES * limit:
            warn(
                f"SA206 {channel.name} in {what} reaches {np.abs(seen).max():g}, "
                f"where its joint's range ends at {limit:g} rad: are these degrees? "
                "Convert them",
                stacklevel=stack_level(),
            )


def _column(name: str, frame: pd.DataFrame, sensors: Sequence[str]) -> str:
    """Return the column of an input; one that a sensor shares is the sensor's."""
    own = f"{name} control"
    return own if name in sensors or own in frame.columns else name

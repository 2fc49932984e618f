"""Logs of a robot as trials: columns are called as actuators and sensors are."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from sbi_active.criticism.data.trials import Trials
from sbi_active.mujoco.models.names import held_places, names_of, start_places
from sbi_active.mujoco.simulator import Channel

__all__ = ["require_in_range", "trials_of"]

Array = NDArray[Any]

TIME = "time"
START = "start "
#: Relative excess over a range that is rounding.
SLACK = 1e-6


def trials_of(
    model: Any,
    recordings: Any,
    channels: Sequence[Channel],
    *,
    inputs: Sequence[str],
) -> Trials:
    """Return logs as trials.

    Each has a column "time", s from the start of the trial, one of each input and one
    of each sensor, and may have "start hinge" or "start hinge velocity", of which the
    first row counts. Where a sensor is called as an input, the input's column is
    "hinge control". A sensor may have NaN where it was not read; an input is held.

    Args:
        model: Compiled.
        recordings: A list of data frames, of dicts of arrays, or of paths of CSV files;
            or one of these for a single trial.
        channels: What the simulator returns.
        inputs: Actuators that are driven.

    Raises:
        ValueError: If a column is missing or not known, the time does not increase, an
            input is NaN, or a control is outside its range.
    """
    if isinstance(recordings, pd.DataFrame | Mapping | str | Path):
        recordings = [recordings]
    if not len(recordings):
        raise ValueError("expected at least one recording; got none; pass logs")
    names = [c.name for c in channels]
    frames = [
        _frame(model, k, given, names, inputs) for k, given in enumerate(recordings)
    ]
    times = [frame[TIME].to_numpy(float) for frame in frames]
    x = [frame[names].to_numpy(float) for frame in frames]
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
    """Raise where a control is outside the range that its actuator has.

    MuJoCo would clip it without a word.

    Args:
        model: Compiled.
        name: Of the actuator.
        values: Of any shape.
        what: Where they come from.
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


def _frame(
    model: Any, k: int, given: Any, names: Sequence[str], inputs: Sequence[str]
) -> pd.DataFrame:
    """Return a log whose columns are as they should be."""
    what = f"recording {k}"
    if isinstance(given, str | Path):
        what = f"{what} ({given})"
        given = pd.read_csv(given, comment="#")
    frame = pd.DataFrame(given)
    frame.columns = [str(c).strip() for c in frame.columns]
    starts = [START + name for name in (*start_places(model), *held_places(model))]
    controls = [_column(name, frame, names) for name in inputs]
    wanted = [TIME, *controls, *names]
    spare = [c for c in frame.columns if c not in {*wanted, *starts}]
    for name in wanted:
        if name not in frame.columns:
            near = difflib.get_close_matches(name, spare, n=3, cutoff=0.4)
            hint = f"rename {' or '.join(map(repr, near))}" if near else "rename or add"
            raise ValueError(
                f"expected a column {name!r} in {what}; got {', '.join(frame.columns)};"
                f" {hint}"
            )
    for name in spare:
        if name.startswith(START):
            near = difflib.get_close_matches(name, starts, n=1) or starts[:1]
            raise ValueError(
                f"expected start states of joints in {what}; got {name!r}; did you "
                f"mean {near[0]!r}?"
            )
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
    for name, column in zip(inputs, controls, strict=True):
        require_in_range(model, name, frame[column].to_numpy(float), what)
    return frame


def _column(name: str, frame: pd.DataFrame, sensors: Sequence[str]) -> str:
    """Return the column of an input; one that a sensor shares is the sensor's."""
    own = f"{name} control"
    return own if name in sensors or own in frame.columns else name

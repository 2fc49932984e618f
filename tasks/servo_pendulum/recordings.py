"""Recorded trials of the servo: what was commanded and what the encoder read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from sbi_active.tasks.servo_pendulum.model import STEP

__all__ = ["DURATION", "RATE", "Recordings", "read_recordings"]

Array = NDArray[Any]

DURATION = 6.0  # s, of a trial
#: Samples a second that are compared. The encoder is read at about 200 Hz, but what a
#: simulator of a servo gets wrong is smooth: at 50 Hz neighboring innovations of an
#: autocorrelated error have a correlation of .9, at 10 Hz up to .6, and at 5 Hz up to
#: .2, so that only there they count as what they are.
RATE = 5.0

TRIAL_COLUMNS = ("trial", "trajectory", "kp")
SAMPLE_COLUMNS = ("trial", "time_s", "goal_rad", "torque_enable", "position_rad")


@dataclass(frozen=True)
class Recordings:
    """Trials of one servo.

    Attributes:
        kp: Position gain of the firmware, shape (t,).
        trajectory: Name of each trial's goal trajectory, t of them.
        goal: In the middle of each step of the simulator, rad, shape (t, steps).
        enabled: Share of each step in which torque is enabled, shape (t, steps).
        start: First angle read, at rest, rad, shape (t,).
        times: Of the angles below, s, shape (k,).
        angle: Read at these times, rad, shape (t, k).
    """

    kp: Array
    trajectory: tuple[str, ...]
    goal: Array
    enabled: Array
    start: Array
    times: Array
    angle: Array

    @classmethod
    def from_samples(
        cls,
        kp: Sequence[float],
        trajectory: Sequence[str],
        samples: Sequence[tuple[Array, Array, Array, Array]],
        *,
        rate: float = RATE,
    ) -> Recordings:
        """Return trials, interpolated where they are needed.

        Args:
            kp: One a trial.
            trajectory: Likewise.
            samples: Of each trial, time, goal, torque enabled and angle, shape (k,)
                each.
            rate: Angles to compare a second.
        """
        every = round(1 / (rate * STEP))
        steps = round(DURATION / STEP) // every * every
        middle = (np.arange(steps) + 0.5) * STEP
        edges = np.arange(steps + 1) * STEP
        times = np.arange(1, steps // every + 1) * every * STEP
        goal, enabled, start, angle = [], [], [], []
        for time, r, on, x in samples:
            goal.append(np.interp(middle, time, r))
            enabled.append(_share(edges, time, on))
            start.append(x[0])
            angle.append(np.interp(times, time, x))
        return cls(
            np.asarray(kp, dtype=np.float64),
            (*trajectory,),
            np.array(goal),
            np.array(enabled),
            np.array(start),
            times,
            np.array(angle),
        )

    def __len__(self) -> int:
        return len(self.kp)

    @property
    def every(self) -> int:
        """Steps of the simulator from one angle to the next."""
        return self.goal.shape[1] // len(self.times)

    @property
    def trajectories(self) -> tuple[str, ...]:
        """Names of the trajectories, by their number in an action."""
        return (*dict.fromkeys(self.trajectory),)

    @property
    def action(self) -> Array:
        """Gain and number of the trajectory, shape (t, 2)."""
        names = self.trajectories
        return np.column_stack([self.kp, [names.index(n) for n in self.trajectory]])

    @property
    def motor_off(self) -> NDArray[np.bool_]:
        """Whether the motor is off for a part of each trial, shape (t,)."""
        return self.enabled.min(1) == 0


def read_recordings(directory: str | Path, *, rate: float = RATE) -> Recordings:
    """Return the trials in a folder.

    Args:
        directory: Holds ``trials.csv`` (trial, trajectory, kp) and ``samples.csv``
            (trial, time_s, goal_rad, torque_enable, position_rad; one row a sample).
        rate: Angles to compare a second.

    Raises:
        FileNotFoundError: If a file is missing.
        ValueError: If a column is missing, or a trial has no samples, NaN, times that
            do not increase, or ends early.
    """
    trials = _table(Path(directory) / "trials.csv", TRIAL_COLUMNS)
    samples = _table(Path(directory) / "samples.csv", SAMPLE_COLUMNS)
    repeated = trials["trial"][trials["trial"].duplicated()].tolist()
    if repeated:
        raise ValueError(
            f"expected one row a trial in trials.csv; got trial {repeated[0]} more "
            "than once; remove all rows but one"
        )
    groups = dict(iter(samples.groupby("trial")))
    parts = []
    for name in trials["trial"]:
        if name not in groups:
            raise ValueError(
                f"expected samples of each of {len(trials)} trials; got none of trial "
                f"{name} in samples.csv; add them, or leave the trial out"
            )
        parts.append(_checked(name, groups[name]))
    return Recordings.from_samples(
        trials["kp"].tolist(), trials["trajectory"].tolist(), parts, rate=rate
    )


def _table(path: Path, columns: Sequence[str]) -> pd.DataFrame:
    if not path.is_file():
        raise FileNotFoundError(
            f"expected recorded trials in {path}; got no such file; give the folder "
            "of trials.csv and samples.csv of the servo pendulum"
        )
    table = pd.read_csv(path)
    missing = [c for c in columns if c not in table.columns]
    if missing:
        raise ValueError(
            f"expected columns {', '.join(columns)} in {path.name}; got no "
            f"{', '.join(missing)} among {', '.join(map(str, table.columns))}; "
            "rename or add them"
        )
    return table


def _checked(name: Any, rows: pd.DataFrame) -> tuple[Array, Array, Array, Array]:
    columns = [rows[c].to_numpy(dtype=np.float64) for c in SAMPLE_COLUMNS[1:]]
    for column, values in zip(SAMPLE_COLUMNS[1:], columns, strict=True):
        if not np.isfinite(values).all():
            row = int(np.flatnonzero(~np.isfinite(values))[0])
            raise ValueError(
                f"expected finite {column}; got {values[row]} in sample {row} of trial "
                f"{name}; remove that sample"
            )
    time, goal, enabled, angle = columns
    if (np.diff(time) <= 0).any():
        row = int(np.flatnonzero(np.diff(time) <= 0)[0])
        raise ValueError(
            f"expected time_s that increases; got {time[row]:g} s, then "
            f"{time[row + 1]:g} s in trial {name}; sort its samples and drop repeats"
        )
    if time[-1] < DURATION - 0.1:
        raise ValueError(
            f"expected {DURATION:g} s of samples; got {time[-1]:g} s in trial {name}; "
            "leave the trial out"
        )
    return time, goal, enabled, angle


def _share(edges: Array, time: Array, on: Array) -> Array:
    """Return the share of each step in which a switch is on, held between samples."""
    width = np.diff(time, append=time[-1] + 1.0)
    total = np.concatenate([[0.0], np.cumsum((on > 0.5) * width)])
    knots = np.concatenate([time, [time[-1] + 1.0]])
    before = np.minimum(edges - time[0], 0.0) * (on[0] > 0.5)  # as at the first sample
    return np.clip(np.diff(np.interp(edges, knots, total) + before) / STEP, 0.0, 1.0)

"""Logs of a robot: what they become, and what is refused."""

import numpy as np
import pandas as pd
import pytest
import torch

from benchmarks.robots.models import SPRING_MASS
from sbi_active.mujoco import from_mjcf
from tests.mujoco.machines import held_arm


def logs(num=2):
    t = np.arange(0, 1, 0.01)
    return [
        pd.DataFrame(
            {"time": t, "push": np.sin(5 * t + k), "position": 0 * t, "speed": 0 * t}
        )
        for k in range(num)
    ]


def test_logs_become_trials():
    frames = logs()
    frames[1].loc[3:5, "position"] = np.nan
    frames[1]["start slide"] = frames[0]["start slide"] = 0.1
    robot = from_mjcf(
        SPRING_MASS, {"cart.mass": (0.5, 2)}, recordings=frames, noise=0.01
    )
    assert robot.trials.x.shape == (2, 100, 2)
    assert robot.trials.x.isnan().sum() == 3
    assert robot.trials.start["slide"].tolist() == [0.1, 0.1]
    x = robot.simulator.mean(
        torch.ones(2, 1),
        robot.trials.action,
        inputs=robot.trials.inputs,
        input_times=robot.trials.input_times,
        start=robot.trials.start,
    )
    assert x[:, 0, 0].tolist() == pytest.approx([0.1, 0.1])


def test_a_log_has_a_column_each_for_a_sensor_and_an_input_of_one_name():
    time = np.arange(0, 0.2, 0.01)
    log = {"time": time, "hinge": 0 * time, "hinge control": 0.3 + 0 * time}
    arm = held_arm("hinge"), {"hinge.damping": (0.0, 1.0)}
    given = {"sensors": ["hinge"], "noise": 0.01}
    robot = from_mjcf(*arm, **given, recordings=[log])
    assert robot.trials.inputs["hinge"].unique().item() == pytest.approx(0.3)
    del log["hinge control"]
    with pytest.raises(ValueError, match="column hinge control "):
        from_mjcf(*arm, **given, recordings=[log])


def out_of_range(frame):
    frame["push"] *= 6


def renamed(frame):
    frame.rename(columns={"push": "pusher"}, inplace=True)


def backwards(frame):
    frame.loc[7, "time"] = 0.015


def without_rows(frame):
    frame.drop(frame.index, inplace=True)


def started_apart(frame):
    frame["start slide"] = 0.1


def timed_by_a_clock(frame):
    frame["time"] += 1.7e9


def of_texts(frame):
    frame["position"] = "0.1 m"


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (without_rows, "samples in recording 1; got no rows"),
        (started_apart, "the same columns in each recording; .*start slide, "),
        (out_of_range, "within its ctrlrange, -5 to 5"),
        (renamed, "the same columns in each recording; .*pusher"),
        (backwards, "times that increase .* recording 1"),
        (timed_by_a_clock, "subtract the time at which"),
        (of_texts, "number in column position, row 1 .*; got .0.1 m."),
    ],
)
def test_logs_that_do_not_fit_are_said(spoil, message):
    frames = logs()
    spoil(frames[1])
    with pytest.raises(ValueError, match=message):
        from_mjcf(SPRING_MASS, {"cart.mass": (0.5, 2)}, recordings=frames)


@pytest.mark.filterwarnings("ignore:2 of 200 cells")
def test_an_input_that_is_not_told_is_held():
    frames = logs()
    frames[1].loc[7, "push"] = np.nan
    with pytest.warns(UserWarning, match="1 rows .* a measurement and no input"):
        robot = from_mjcf(SPRING_MASS, {"cart.mass": (0.5, 2)}, recordings=frames)
    push = robot.trials.inputs["push"][1]
    assert push[7] == push[6]


def encoder_log(**changes):
    time = np.arange(0.0, 1.0, 0.02)
    log = {"time": time, "angle": 0.3 * np.sin(3 * time), "servo": 0 * time}
    return {**log, **changes}


def read_logs(*logs, xml=None):
    return from_mjcf(
        xml or held_arm("servo"),
        {"hinge.damping": (0.0, 1.0)},
        noise=0.01,
        recordings=[*logs],
    ).trials


def test_dates_are_seconds_since_the_first():
    for unit in ("ms", "us", "ns"):
        stamps = np.datetime64("2026-01-01") + (20 * np.arange(50)).astype(
            "timedelta64[ms]"
        ).astype(f"timedelta64[{unit}]")
        dates = pd.Series(stamps).dt.tz_localize("UTC")
        for time in (stamps, dates):
            trials = read_logs(encoder_log(time=time))
            assert trials.sample_times.tolist() == pytest.approx(
                (0.02 * np.arange(50)).tolist()
            )


@pytest.mark.filterwarnings("error")
def test_a_log_of_milliseconds_is_said_before_anything_runs():
    with pytest.raises(UserWarning, match="10,000 time steps of 0.002 s.*in ms"):
        read_logs(encoder_log(time=1_000 * encoder_log()["time"]))


def test_angles_that_wrap_or_are_degrees_are_said():
    turning = np.linspace(0, 15, 50)
    with pytest.warns(UserWarning, match=r"jumps by about 2 pi in 2 places"):
        read_logs(encoder_log(angle=np.remainder(turning, 2 * np.pi)))
    limits = 'axis="0 1 0" limited="true" range="-90 90"'
    limited = held_arm("servo").replace('axis="0 1 0"', limits)
    limited = limited.replace('name="angle"', 'name="hinge"')
    log = encoder_log(hinge=np.linspace(0, 60, 50))
    del log["angle"]
    with pytest.warns(UserWarning, match="range ends at 1.57.* rad: are these degrees"):
        read_logs(log, xml=limited)

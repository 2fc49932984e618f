"""Logs of a robot: what they become, and what is refused."""

import numpy as np
import pandas as pd
import pytest
import torch

from benchmarks.robots.models import PENDULUM, SPRING_MASS
from sbi_active.mujoco import from_mjcf, identify_robot
from tests.mujoco.machines import held_arm, stepped


def logs():
    """Two logs at 100 Hz, of which the position was read at 10 Hz."""
    t = np.arange(0, 1, 0.01)
    slow = np.where(np.arange(100) % 10, np.nan, t)
    rest = {"position": slow, "speed": t, "start slide": 0.1 + 0 * t}
    return [pd.DataFrame({"time": t, "push": np.sin(f * t), **rest}) for f in (5, 6)]


def read(frames):
    return from_mjcf(SPRING_MASS, {"cart.mass": (0.5, 2)}, recordings=frames, noise=0.1)


def test_logs_become_trials():
    robot = read(logs())
    assert robot.trials.x.shape == (2, 100, 2)
    assert robot.trials.x.isfinite().sum((0, 1)).tolist() == [20, 200]
    assert robot.trials.start["slide"].tolist() == [0.1, 0.1]
    x = robot.simulator.mean(
        torch.ones(2, 1),
        robot.trials.action,
        inputs=robot.trials.inputs,
        input_times=robot.trials.input_times,
        start=robot.trials.start,
    )
    assert x[:, 0, 0].tolist() == pytest.approx([0.1, 0.1])


@pytest.mark.filterwarnings("error")
def test_logs_become_si_as_tables_do(tmp_path):
    """One reading of headers; see criticism/data/test_trials for tables."""
    units = {"time": "ms", "position": "mm", "speed": "mm/s", "start slide": "mm"}
    names = {name: f"{name} [{unit}]" for name, unit in units.items()}
    for k, log in enumerate(logs()):
        log = log.assign(**{name: 1e3 * log[name] for name in units})
        log.rename(columns=names).to_csv(tmp_path / f"{k}.csv", index=False)
    converted, same = read(tmp_path).trials, read(logs()).trials
    for name in ("x", "sample_times", "input_times"):
        found, expected = getattr(converted, name), getattr(same, name)
        assert np.allclose(found, expected, equal_nan=True), name
    assert converted.start["slide"].tolist() == pytest.approx([0.1, 0.1])


#: Columns renamed, and what is said of them.
NO_UNITS = [
    ({"position": "position [px]"}, r"'position' in m; got \[px\] in the rec"),
    ({"position": "position [deg]"}, r"'position' in m; got \[deg\] in the rec"),
    ({"time": "time [mm]"}, r"times in s, .* got mm"),
    ({"start slide": "position [m]"}, "each quantity once; got position and"),
]


@pytest.mark.parametrize(("names", "message"), NO_UNITS)
def test_units_that_cannot_be_those_of_the_model_are_refused(names, message):
    with pytest.raises(ValueError, match=message):
        read([log.rename(columns=names) for log in logs()])


def test_a_log_has_a_column_each_for_a_sensor_and_an_input_of_one_name():
    time = np.arange(0, 0.2, 0.01)
    log = {"time": time, "hinge": 0 * time, "hinge control": 0.3 + 0 * time}
    arm = held_arm("hinge"), {"hinge.damping": (0.0, 1.0)}
    given = {"sensors": ["hinge"], "noise": 0.01}
    robot = from_mjcf(*arm, **given, recordings=[log])
    assert robot.trials.inputs["hinge"].unique().item() == pytest.approx(0.3)
    del log["hinge control"]
    with pytest.raises(ValueError, match="column hinge control;"):
        from_mjcf(*arm, **given, recordings=[log])


#: What spoils a log, and what is said of it.
NO_LOGS = [
    (lambda log: log[:0], "got no rows in recording 1"),
    (lambda log: log.assign(push=6 * log["push"]), "its ctrlrange, -5 to 5"),
    (lambda log: log.drop(columns="start slide"), "same columns .*start slide"),
    (lambda log: log[::-1], "times that increase .* recording 1"),
    (lambda log: log.assign(time=1.7e9 + log["time"]), "subtract the time at which"),
]


@pytest.mark.parametrize(("spoil", "message"), NO_LOGS)
def test_logs_that_do_not_fit_are_said(spoil, message):
    one, other = logs()
    with pytest.raises(ValueError, match=message):
        read([one, spoil(other)])


@pytest.mark.filterwarnings("ignore:.* cells")
def test_an_input_that_is_not_told_is_held():
    one, other = logs()
    other.loc[7, "push"] = np.nan
    with pytest.warns(UserWarning, match="1 rows .* a measurement and no input"):
        push = read([one, other]).trials.inputs["push"][1]
    assert push[7] == push[6]


HELD = held_arm("servo")


def encoder_log(**changes):
    time = np.arange(0.0, 1.0, 0.02)
    log = {"time": time, "angle": 0.3 * np.sin(3 * time), "servo": 0 * time}
    return {**log, **changes}


def read_log(log, xml=HELD):
    arm = xml, {"hinge.damping": (0.0, 1.0)}
    return from_mjcf(*arm, noise=0.01, recordings=[log]).trials


@pytest.mark.filterwarnings("error")
def test_a_log_of_milliseconds_is_said_before_anything_runs():
    with pytest.raises(UserWarning, match="10,000 time steps of 0.002 s.*in ms"):
        read_log(encoder_log(time=1_000 * encoder_log()["time"]))


def test_angles_that_wrap_or_are_degrees_are_said():
    turning = np.linspace(0, 15, 50)
    with pytest.warns(UserWarning, match=r"jumps by about 2 pi in 2 places"):
        read_log(encoder_log(angle=np.remainder(turning, 2 * np.pi)))
    limits = 'axis="0 1 0" limited="true" range="-90 90"'
    limited = HELD.replace('axis="0 1 0"', limits)
    limited = limited.replace('name="angle"', 'name="hinge"')
    log = encoder_log(hinge=np.linspace(0, 60, 50))
    del log["angle"]
    with pytest.warns(UserWarning, match="range ends at 1.57.* rad: are these degrees"):
        read_log(log, limited)


# A robot's parameters from logs of one that has dry friction besides


TRUTH = 0.03


def log(start, rng, friction):
    text = PENDULUM.replace("0.03", f'{TRUTH}" frictionloss="{friction}')
    angles = [start, *stepped(text, 200, qpos=start)[1:, 0]]
    angles = np.array(angles) + 0.005 * rng.standard_normal(200)
    time, begin = 0.01 * np.arange(200), np.full(100, start)
    return {"time": time[::2], "encoder": angles[::2], "start hinge": begin}


def robot(friction):
    rng = np.random.default_rng(3)
    logs = [log(start, rng, friction) for start in (0.6, -1.2, 1.5, -0.9)]
    unknown = {"hinge.damping": (0.0, 0.3)}
    return from_mjcf(PENDULUM, unknown, recordings=logs, noise=0.005)


def test_undeclared_friction_is_beside_it():
    for friction in (0.0, 0.05):
        belief = identify_robot(robot(friction))
        low, high = belief.interval()["hinge.damping"]
        assert low < TRUTH < high
        assert high - low < 0.03
        share = belief.diagnostics.beside["hinge friction loss"]
        assert share == pytest.approx(float(friction > 0), abs=0.2)


def test_without_anything_beside_it_is_wide_and_says_so():
    belief = identify_robot(robot(0.05), beside=())
    low, high = belief.interval()["hinge.damping"]
    assert low < TRUTH < high
    assert "disagree about hinge.damping" in belief.diagnostics.warnings[0]

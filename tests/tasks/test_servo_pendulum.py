import math

import numpy as np
import pandas as pd
import pytest
import torch

from sbi_active.tasks import get_task  # pyright: ignore
from sbi_active.tasks.servo_pendulum import (  # pyright: ignore
    Recordings,
    ServoPendulumTask,
    read_recordings,
)

THETA = torch.tensor([[0.45, 5.0, 0.0045, 0.0015, -0.02]], dtype=torch.float64)
TIME = np.arange(0.004, 6.01, 0.005)


def samples(trajectory, start=0.0):
    """Time, goal, torque enabled and angle of one trial, in which nothing moves."""
    if trajectory == "fall":
        goal, on = np.zeros_like(TIME), np.zeros_like(TIME)
    elif trajectory == "lift_and_drop":
        s = np.minimum(TIME / 2, 1.0)
        goal, on = -math.pi / 2 * (3 * s**2 - 2 * s**3), (TIME < 2.0).astype(float)
    else:
        goal, on = np.sin(TIME**2), np.ones_like(TIME)
    return TIME, goal, on, np.full_like(TIME, start)


def recordings(*trials, rate=5.0):
    """Trials given as (kp, trajectory, start)."""
    kp, names, start = zip(*trials, strict=True)
    parts = [samples(n, s) for n, s in zip(names, start, strict=True)]
    return Recordings.from_samples(kp, names, parts, rate=rate)


@pytest.fixture(scope="module")
def task():
    trials = [
        (kp, name, 0.0)
        for kp in (100.0, 400.0)
        for name in ("sin_time_square", "lift_and_drop")
    ]
    return ServoPendulumTask(data=recordings(*trials))


def every_trial(task, theta=THETA, **friction):
    action = torch.from_numpy(task.recordings.action)
    return task.angles(theta.expand(len(action), -1), action, **friction).numpy()


@pytest.mark.parametrize(
    ("friction", "tolerance"),
    [({}, 0.004), ({"viscous": 0.01}, 0.004), ({"coulomb": 0.05}, 0.01)],
)
def test_the_equations_agree_with_mujoco_at_an_eighth_of_the_step(
    task, friction, tolerance
):
    pytest.importorskip("mujoco")
    from tests.tasks.servo_scene import mujoco_angles

    own = every_trial(task, **friction)
    assert np.ptp(own[1:3], axis=1).min() > 0.2  # they swing
    for trial in (1, 2):
        x = mujoco_angles(THETA[0].numpy(), task.recordings, trial, **friction)
        assert np.abs(own[trial] - x).max() < tolerance


def test_a_free_pendulum_keeps_its_energy_without_friction_alone():
    fall = ServoPendulumTask(data=recordings((100.0, "fall", 1.0), rate=50.0))
    strengths: list[dict[str, float]] = [{}, {"load": 0.2}, {"torque": 1.0}]
    free, damped, motor = (every_trial(fall, **f)[0] for f in strengths)
    late = fall.recordings.times > 4
    assert np.abs(free[late] + 0.02).max() == pytest.approx(1.02, abs=2e-3)
    assert np.abs(damped[late]).max() < 0.3
    assert np.array_equal(motor, free)  # no torque while the motor is off


def test_effects_vanish_at_zero(task):
    bare = every_trial(task)
    assert [e.name for e in task.effects()] == [
        "Coulomb",
        "load-dependent",
        "torque-dependent",
        "viscous",
    ]
    for keyword in ("coulomb", "load", "torque", "viscous"):
        assert np.array_equal(every_trial(task, **{keyword: 0.0}), bare)
        assert np.abs(every_trial(task, **{keyword: 0.05}) - bare).max() > 0.01


# Reading what was recorded


@pytest.fixture
def folder(tmp_path):
    tables = []
    for i, name in enumerate(("sin_time_square", "lift_and_drop")):
        time, goal, on, angle = samples(name, 0.1 * i)
        tables.append(
            pd.DataFrame(
                {
                    "trial": i,
                    "time_s": time,
                    "goal_rad": goal,
                    "torque_enable": on,
                    "position_rad": angle,
                }
            )
        )
    pd.concat(tables).to_csv(tmp_path / "samples.csv", index=False)
    pd.DataFrame(
        {"trial": [0, 1], "trajectory": ["sin_time_square", "lift_and_drop"], "kp": 100}
    ).to_csv(tmp_path / "trials.csv", index=False)
    return tmp_path


def test_reading_interpolates_and_finds_when_the_motor_is_off(folder):
    found = read_recordings(folder)
    assert found.angle.shape == (2, 30)
    assert found.times[[0, -1]].tolist() == pytest.approx([0.2, 6.0])
    assert found.angle[1] == pytest.approx(np.full(30, 0.1))
    middle = (np.arange(1500) + 0.5) * 0.004
    # Linear interpolation over 5 ms of a second derivative up to 4 t^2 + 2.
    assert np.abs(found.goal[0] - np.sin(middle**2))[2:].max() < 146 * 0.005**2 / 8
    # Off from the first sample at or after 2 s, which is at 2.004 s.
    assert found.enabled[1].sum() * 0.004 == pytest.approx(2.004, abs=1e-9)
    assert get_task("servo_pendulum", data=folder).actions.values.tolist() == [
        [100.0, 0.0],
        [100.0, 1.0],
    ]

"""A robot's parameters from logs of one that has dry friction besides."""

import numpy as np
import pytest

from benchmarks.robots.models import PENDULUM
from sbi_active.mujoco import from_mjcf, identify_robot
from tests.mujoco.machines import stepped

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

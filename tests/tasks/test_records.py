"""Machines that have records: their equations, their effects, and reading them."""

import math

import numpy as np
import pandas as pd
import pytest
import torch

from sbi_active.tasks import ball_and_hoop, cascaded_tanks, get_task
from sbi_active.tasks.ball_and_hoop import spin
from sbi_active.tasks.cascaded_tanks import levels, start_levels
from sbi_active.tasks.records import Record, cut
from sbi_active.tasks.servo_pendulum import (
    Recordings,
    ServoPendulumTask,
    read_recordings,
)
from sbi_active.tasks.servo_pendulum.model import GRAVITY, LENGTH, MASS, STEP, SUPPLY
from sbi_active.tasks.stepping import lagged

HOOP = torch.tensor([[7.3, 0.8, 0.0]], dtype=torch.float64)
TANKS = torch.tensor([[0.05, 0.05, 0.05, 0.04]], dtype=torch.float64)
FILLED = [*cascaded_tanks.make_effects(), start_levels()]
#: Equations, parameters, effects, time step, and bounds of the voltage.
MACHINES = {
    "hoop": (spin, HOOP, ball_and_hoop.make_effects(), 0.1, (-0.9, 0.9)),
    "tanks": (levels, TANKS, FILLED, 4.0, (0.5, 6.0)),
}


def record(step, bounds, num=240):
    """Steps between the bounds, and a first output."""
    rng = np.random.default_rng(0)
    voltage = np.repeat(rng.uniform(*bounds, num // 20), 20)
    return Record("made", step, voltage, np.linspace(4.0, 11.0, num))


def run(name, num=1, **effects):
    fn, theta, _, step, bounds = MACHINES[name]
    pieces = cut(record(step, bounds), 120, every=4, slope=6 * (name == "tanks"))
    return fn(theta.expand(num * len(pieces), -1), **pieces.rows(num), **effects)


@pytest.mark.parametrize("name", [*MACHINES])
def test_effects_vanish_at_zero_and_have_a_slope_there(name):
    bare = run(name)
    assert bare.isfinite().all()
    for effect in MACHINES[name][2]:
        unit = effect.prior.stddev.double().expand(2, -1)
        sizes = []
        for share in (0.0, 1e-4, 1e-2):
            x = run(name, **effect.apply({}, share * unit, None, None))
            sizes.append(float((x - bare).norm()))
        assert sizes[0] == 0, effect.name
        assert sizes[2] > 0, effect.name
        assert sizes[1] == pytest.approx(sizes[2] / 100, rel=0.3), effect.name


def test_the_hoop_follows_the_linear_equation():
    voltage = torch.ones(1, 40)
    times = torch.linspace(0.1, 4.0, 40)
    x = spin(HOOP, torch.zeros(1, 2), inputs={"voltage": voltage}, times=times)
    exact = 7.3 / 0.8 * (1 - torch.exp(-0.8 * times))
    torch.testing.assert_close(x[0], exact.double(), atol=0.01, rtol=0)


def test_dry_friction_holds_the_hoop_and_never_turns_it_around():
    voltage = torch.full((1, 60), 0.05)
    times = torch.linspace(0.1, 6.0, 60)
    start = torch.tensor([[0.0, 0.0], [0.0, 2.0]], dtype=torch.float64)
    rows = {"inputs": {"voltage": voltage.expand(2, -1)}, "times": times}
    x = spin(HOOP.expand(2, -1), start, **rows, coulomb=1.0)
    assert x[0].abs().max() == 0
    assert (x[1].diff() <= 0).all()
    assert x[1].min() >= 0


def test_a_lag_is_exact_for_a_step_and_has_a_slope_below_a_step():
    drive = torch.cat([torch.zeros(1, 2), torch.ones(50, 2)]).double()
    steps = torch.tensor([5.0, 1e-3], dtype=torch.float64)
    x = lagged(drive, steps)
    ends = torch.arange(51, dtype=torch.float64)
    filled = 5 * (1 - torch.exp(-ends / 5))  # integral of what still lacks
    torch.testing.assert_close((drive - x)[:, 0].cumsum(0), filled)
    assert (drive - x)[1, 1] == pytest.approx(1e-3)


def test_tanks_keep_their_water():
    """What is pumped less what flows out is what is there, both areas alike."""
    theta = torch.tensor([[0.05, 0.05, 1e-9, 0.04]], dtype=torch.float64)
    voltage = torch.full((1, 100), 2.0)
    out = levels(
        theta,
        torch.tensor([[0.0, 1.0, 0.1]]),
        inputs={"voltage": voltage},
        times=torch.tensor([400.0]),
    )
    upper = 4.0  # (.1 / .05)^2, which makes the slope below; it sinks to 2.56
    for _ in range(40_000):
        upper += 0.01 * (0.08 - 0.05 * upper**0.5)
    assert float(out) == pytest.approx(1.0 + 400 * 0.08 - (upper - 4.0), rel=1e-4)


SERVO = torch.tensor([[0.45, 5.0, 0.0045, 0.0015, -0.02]], dtype=torch.float64)
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
    names = ("sin_time_square", "lift_and_drop")
    trials = [(kp, name, 0.0) for kp in (100.0, 400.0) for name in names]
    return ServoPendulumTask(data=recordings(*trials))


def every_trial(task, theta=SERVO, **friction):
    action = torch.from_numpy(task.recordings.action)
    return task.angles(theta.expand(len(action), -1), action, **friction).numpy()


def stepped_finely(theta, recordings, trial, *, coulomb=0.0, viscous=0.0):
    """Euler's rule at a fiftieth of the step: the equation of motion as it stands."""
    kt, resistance, gain, armature, zero = theta
    inertia, h = MASS * LENGTH**2 + armature, STEP / 50
    q, v, found = recordings.start[trial] - zero, 0.0, []
    for goal, on in zip(recordings.goal[trial], recordings.enabled[trial], strict=True):
        for _ in range(50):
            duty = gain * recordings.kp[trial] * (goal - zero - q)
            duty = min(max(duty, -1.0), 1.0)
            torque = on * kt / resistance * (SUPPLY * duty - kt * v)
            torque -= MASS * GRAVITY * LENGTH * math.sin(q) + viscous * v
            momentum = inertia * v + h * torque
            left = max(abs(momentum) - h * coulomb, 0.0)
            v = math.copysign(left, momentum) / inertia
            q += h * v
        found.append(q + zero)
    return np.array(found[recordings.every - 1 :: recordings.every])


@pytest.mark.parametrize(
    ("friction", "tolerance"),
    [({}, 0.004), ({"viscous": 0.01}, 0.004), ({"coulomb": 0.05}, 0.01)],
)
def test_the_equations_are_those_of_a_fiftieth_of_the_step(task, friction, tolerance):
    own = every_trial(task, **friction)
    assert np.ptp(own[1:3], axis=1).min() > 0.2  # they swing
    for trial in (1, 2):
        x = stepped_finely(SERVO[0].tolist(), task.recordings, trial, **friction)
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
    keywords = {"coulomb", "load", "torque", "viscous"}
    assert len(task.effects()) == len(keywords)
    for keyword in keywords:
        assert np.array_equal(every_trial(task, **{keyword: 0.0}), bare)
        assert np.abs(every_trial(task, **{keyword: 0.05}) - bare).max() > 0.01


# Reading what was recorded


def test_reading_interpolates_and_finds_when_the_motor_is_off(tmp_path):
    names, columns = ["sin_time_square", "lift_and_drop"], ["time_s", "goal_rad"]
    columns += ["torque_enable", "position_rad"]
    tables = [
        pd.DataFrame(dict(zip(columns, samples(name, 0.1 * i), strict=True)))
        for i, name in enumerate(names)
    ]
    every = pd.concat(tables, keys=[0, 1], names=["trial"]).reset_index(level="trial")
    every.to_csv(tmp_path / "samples.csv", index=False)
    trials = pd.DataFrame({"trial": [0, 1], "trajectory": names, "kp": 100})
    trials.to_csv(tmp_path / "trials.csv", index=False)
    found = read_recordings(tmp_path)
    assert found.angle.shape == (2, 30)
    assert found.times[[0, -1]].tolist() == pytest.approx([0.2, 6.0])
    assert found.angle[1] == pytest.approx(np.full(30, 0.1))
    middle = (np.arange(1500) + 0.5) * 0.004
    # Linear interpolation over 5 ms of a second derivative up to 4 t^2 + 2.
    assert np.abs(found.goal[0] - np.sin(middle**2))[2:].max() < 146 * 0.005**2 / 8
    # Off from the first sample at or after 2 s, which is at 2.004 s.
    assert found.enabled[1].sum() * 0.004 == pytest.approx(2.004, abs=1e-9)
    actions = get_task("servo_pendulum", data=tmp_path).actions.values
    assert actions.tolist() == [[100.0, 0.0], [100.0, 1.0]]

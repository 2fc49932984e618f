"""The MJCF of a quadruped with twelve joints, where its files are there."""

from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch

from sbi_active.criticism import AugmentedSimulator
from sbi_active.mujoco import from_mjcf, mjcf_effects

DATA = Path(__file__).parents[2] / "../shared/data/go2_in_air"
LEG = ["FL_hip_joint", "FL_thigh_joint", "FL_calf_joint"]

pytestmark = pytest.mark.skipif(
    not (DATA / "go2_in_air.xml").is_file(),
    reason=f"needs the files of go2_in_air in {DATA}",
)


@pytest.fixture(scope="module")
def robot():
    """Return a robot whose motors are the drives, and a first piece of its record."""
    spec = mujoco.MjSpec.from_file(str(DATA / "go2_in_air.xml"))
    for motor in spec.actuators:
        motor.set_to_position(kp=20.0, kv=1.5)
        motor.forcerange, motor.ctrlrange = motor.ctrlrange.copy(), [-4.0, 4.0]
    names = (DATA / "trajectory.csv").read_text().splitlines()[0].split(",")
    rows = np.genfromtxt(DATA / "trajectory.csv", delimiter=",", skip_header=1)[:400]
    table = dict(zip(names, rows.T, strict=True))
    joints = [j.name for j in spec.joints]
    log = {"time": table["time_s"]}
    for joint, motor in zip(joints, spec.actuators, strict=True):
        column = joint.removesuffix("_joint")
        log[motor.name] = table[f"goal_{column}"]
        log[joint] = table[f"q_{column}"]
        log[f"start {joint}"] = table[f"q_{column}"]
    return from_mjcf(
        spec,
        {f"{joint}.damping": (0.0, 2.0) for joint in LEG},
        sensors=joints,
        recordings=[log],
        noise=0.005,
    )


def test_a_record_is_followed(robot):
    trials = robot.trials
    x = robot.simulator.mean(
        torch.full((1, 3), 0.6),
        trials.action,
        inputs=trials.inputs,
        input_times=trials.input_times,
        start=trials.start,
    )
    error = (x - trials.x)[0].square().mean(0).sqrt()
    assert x.shape == (1, 400, 12)
    assert error.max() < 0.15  # rad, of motions of more than half a radian


def test_alike_joints_are_offered_together_and_one_by_one(robot):
    effects = {
        e.name: e
        for e in mjcf_effects(robot, include=["*friction loss", "*series elasticity"])
    }
    losses = [n for n in effects if n.endswith("friction loss")]
    assert len(losses) == 15
    tied = [n for n in losses if n.startswith("all ")]
    assert {"calf" in n for n in tied} == {True, False}
    (calf,) = (n for n in tied if "calf" in n)
    model = AugmentedSimulator(robot.simulator, [effects[calf]])
    trials = robot.trials
    from sbi_active.criticism import Context

    context = Context(
        index=torch.zeros(2, dtype=torch.float64),
        times=trials.sample_times,
        inputs={k: u.expand(2, -1) for k, u in trials.inputs.items()},
        input_times=trials.input_times,
        start={k: v.expand(2) for k, v in trials.start.items()},
    )
    theta = torch.full((2, 3), 0.6, dtype=torch.float64)
    phi = torch.tensor([[0.0], [1.5]], dtype=torch.float64)
    x = model.evaluate(
        theta, {calf: phi}, trials.action.expand(2, -1).double(), context=context
    )
    moved = (x[1] - x[0]).abs().amax(0)
    assert (moved[2::3] > 0.01).all()

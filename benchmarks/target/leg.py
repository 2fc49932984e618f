"""One leg of the Go2 in the air, and the feedforward of its hip.

Eight parameters: damping, dry friction and armature of hip and thigh, damping and dry
friction of the knee. The hip is to follow a fast swing while thigh and knee are held.
Its drive adds what the rigid leg takes to what armature, damping and dry friction take
besides, so that the controller rests on these three.

A trial moves one joint by its drive, slowly or fast; the others are held. Each gives
the three angles at 30 times. No trial moves two joints at once.

The cost is the mean square of the tracking error in units of 20 mrad, and one for the
backlash that no feedforward takes away.

Before any row, on other truths: the hip's job was taken, and 4 mrad, since a knee's
trials tell most and are the first of either arm, and 10 mrad left gains open (four and
five truths of each).
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import torch
from torch import Tensor

from benchmarks.robots.machines import go2_leg
from sbi_active import DiscreteActions
from sbi_active.actions import SignalActions
from sbi_active.mujoco import from_mjcf
from sbi_active.mujoco.models.spec import mujoco

DIFFERENCE = 0.03  # deviations of the prior, of slopes of a trial; dry friction jumps
JOINTS = ("hip", "thigh", "calf")
PARTS = {"damping": "damping", "friction": "frictionloss", "armature": "armature"}
NAMES = [f"{j} {p}" for j in JOINTS for p in PARTS if (j, p) != ("calf", "armature")]
#: N m s/rad, N m, kg m^2: by log-normal factors.
TYPICAL = {"damping": 0.3, "friction": 0.3, "armature": 0.02}
SPREAD = torch.full((8,), 0.5)
CENTER, REACH = (0.0, 0.9, -1.8), 0.4  # rad
STEP, EVERY, NUM_READ = 0.005, 10, 30
TRIALS = DiscreteActions(
    [[float(joint), hertz] for joint in range(3) for hertz in (0.7, 3.0)],
    names=["kind", "size"],
)
SENSOR = torch.tensor(0.004).repeat(3 * NUM_READ)  # rad
KP, KD = 20.0, 1.5  # of the drives
TIMES = torch.arange(0, (EVERY * NUM_READ + 1) * STEP, STEP).double()
PACE, SWING = 2 * math.pi * 1.5, 0.3  # of the hip's job: rad/s, rad
LEAD = 0.00125  # s, of goals that are held for a step: the right gains cost least
CREEP = 0.05  # rad/s, below which a joint may stand
TOLERANCE = 0.02  # rad


def parameters(theta: Tensor) -> Tensor:
    """Return dampings, frictions and armatures by ``NAMES``, shape (n, 8)."""
    nominal = torch.tensor([TYPICAL[name.split()[1]] for name in NAMES])
    return nominal.to(theta) * theta.exp()


def moved(action: Tensor, times: Tensor) -> dict[str, Tensor]:
    """Return the goals of a trial, of one joint around its place, {drive: (n, m)}."""
    joint, hertz = action[:, :1].round(), action[:, 1:]
    wave = REACH * torch.sin(2 * math.pi * hertz * times)
    return {
        f"FL_{name}": CENTER[k] + torch.where(joint == k, wave, 0.0)
        for k, name in enumerate(JOINTS)
    }


class Job:
    """The hip's swing as a generator of goals, by a controller's gains.

    Args:
        model: The leg with neither damping nor armature nor dry friction.
    """

    names = ("armature", "damping", "friction")

    def __init__(self, model: Any) -> None:
        angle = PACE * (TIMES + LEAD)
        self.way = CENTER[0] + SWING * (1 - angle.cos())
        self.speed, self.acceleration = SWING * PACE * angle.sin(), angle.cos()
        self.acceleration *= SWING * PACE**2
        data, torques = mujoco.MjData(model), []
        for at, speed, faster in zip(
            self.way, self.speed, self.acceleration, strict=True
        ):
            data.qpos[:] = (float(at), *CENTER[1:])
            data.qvel[0], data.qacc[0] = float(speed), float(faster)
            mujoco.mj_inverse(model, data)
            torques.append(data.qfrc_inverse.tolist())
        self.rigid = torch.tensor(torques, dtype=torch.float64)

    def __call__(self, gain: Tensor, times: Tensor) -> dict[str, Tensor]:
        """Return the goals of the drives, {drive: (n, m)}."""
        armature, damping, friction = gain.double().split(1, 1)
        torque = armature * self.acceleration + (damping + KD) * self.speed
        torque = torque + friction * (self.speed / CREEP).tanh()
        held = torch.zeros_like(torque)
        way = self.way + torque / KP, held + CENTER[1], held + CENTER[2]
        return {
            f"FL_{name}": goal + rigid / KP
            for name, goal, rigid in zip(JOINTS, way, self.rigid.T, strict=True)
        }


def plain_leg() -> Any:
    """Return the leg at this step, with nothing that takes torque but its mass."""
    spec = go2_leg()
    spec.option.timestep = STEP
    for joint in spec.joints:
        joint.armature = joint.frictionloss = 0
        joint.damping = [0, 0, 0]
    return spec


@cache
def robot_of(is_job: bool) -> Any:
    """Return the robot that does its job, or the one that is tried."""
    generator = Job(plain_leg().compile()) if is_job else moved
    ends = ([0.0] * 3, [0.1, 1.0, 1.0]) if is_job else ([-0.5, 0.1], [2.5, 10.0])
    names = None if is_job else TRIALS.names
    space = SignalActions(generator, *ends, input_times=TIMES, names=names)
    joints = [f"FL_{name}_joint" for name in JOINTS]
    known = [name.split() for name in NAMES]
    return from_mjcf(
        plain_leg(),
        {f"{j} {p}": (0.0, 20.0, f"FL_{j}_joint.{PARTS[p]}") for j, p in known},
        inputs=space,
        sensors=joints,
        times=TIMES[::EVERY][1:].numpy() if not is_job else TIMES[1:].numpy(),
        noise=1.0,
        start=dict(zip(joints, CENTER, strict=True)),
    )


def trial(theta: Tensor, action: Tensor) -> Tensor:
    """Return the three angles at all times, shape (n, 3 * times)."""
    return robot_of(False).simulator.mean(parameters(theta), action).flatten(1)


def gains(theta: Tensor) -> Tensor:
    """Return the hip's armature, damping and dry friction, shape (n, 3)."""
    known = dict(zip(NAMES, parameters(theta).T, strict=True))
    return torch.stack([known[f"hip {name}"] for name in Job.names], 1)


def cost(theta: Tensor, gain: Tensor) -> Tensor:
    """Return the cost of a feedforward (n, 3) on machines (n, 8)."""
    robot = robot_of(True)
    x = robot.simulator.mean(parameters(theta), gain)
    way = CENTER[0] + SWING * (1 - (PACE * TIMES[1:]).cos())
    return 1 + ((x[..., 0] - way) / TOLERANCE).square().mean(1)

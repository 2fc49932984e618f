"""Ten robots that others published, and how each is driven, started and read.

Five ship with dm_control and three with gymnasium, which need not run: their MJCFs are
read. The Go2's leg is that of :mod:`.machines`; the servo is a position-controlled
motor with a weight of .49 kg on .1 m, as in the measured records of one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from math import pi
from typing import Any

from benchmarks.robots.machines import go2_leg, shipped
from sbi_active.mujoco.models.spec import mujoco_of

SERVO = """<mujoco model="servo">
<option timestep="0.005" integrator="implicitfast"/>
<worldbody><body name="weight">
  <joint name="hinge" axis="0 1 0" damping="0.02" armature="0.001"/>
  <geom type="capsule" fromto="0 0 0 0 0 -.1" size=".01" mass=".03"/>
  <geom type="sphere" pos="0 0 -.1" size=".02" mass=".49"/>
</body></worldbody>
<actuator><position name="servo" joint="hinge" kp="2" kv=".05" forcerange="-.6 .6"/>
</actuator></mujoco>"""


@dataclass(frozen=True)
class Public:
    """A robot, and how trials of it are run.

    Attributes:
        spec: Makes an ``MjSpec``.
        parameters: What is unknown, as ``from_mjcf`` takes it.
        read: Joints that are read, each with its sensor's deviation, rad or m.
        drive: Amplitude and center of the control, by actuator.
        start: Center and half width of the start, by joint.
        seconds: Length of a trial.
    """

    spec: Callable[[], Any]
    parameters: dict[str, tuple[float, float]]
    read: dict[str, float]
    drive: dict[str, tuple[float, float]]
    start: dict[str, tuple[float, float]]
    seconds: float = 2.0


def _suite(name: str) -> Callable[[], Any]:
    return partial(shipped, "dm_control", f"suite/{name}.xml")


def _gymnasium(name: str) -> Callable[[], Any]:
    return partial(shipped, "gymnasium", f"envs/mujoco/assets/{name}.xml")


def _servo() -> Any:
    return mujoco_of().MjSpec.from_string(SERVO)


LEG = ("hip", "thigh", "calf")

#: Joints of the arm that pushes, from the shoulder on.
PUSHER = ("shoulder_pan", "shoulder_lift", "upper_arm_roll", "elbow_flex")
PUSHER += ("forearm_roll", "wrist_flex", "wrist_roll")

PUBLIC = {
    "pendulum": Public(
        _suite("pendulum"),
        {"hinge.damping": (0.0, 0.5), "pole.mass": (0.5, 2.0)},
        read={"hinge": 0.005},
        drive={"torque": (1.0, 0.0)},
        start={"hinge": (pi, 1.0)},
    ),
    "cart-pole": Public(
        _suite("cartpole"),
        {"cart.mass": (0.5, 2.0), "slider.damping": (0.0, 1.0)},
        read={"slider": 0.002, "hinge_1": 0.005},
        drive={"slide": (0.4, 0.0)},
        start={"slider": (0.0, 0.2), "hinge_1": (pi, 0.6)},
    ),
    "acrobot": Public(
        _suite("acrobot"),
        {"shoulder.damping": (0.0, 0.3), "lower_arm.mass": (0.5, 2.0)},
        read={"shoulder": 0.005, "elbow": 0.005},
        drive={"elbow": (1.0, 0.0)},
        start={"shoulder": (pi, 0.8), "elbow": (0.0, 0.5)},
    ),
    "reacher": Public(
        _suite("reacher"),
        {"shoulder.damping": (0.0, 0.05), "hand.mass": (0.02, 0.1)},
        read={"shoulder": 0.005, "wrist": 0.005},
        drive={"shoulder": (0.6, 0.0), "wrist": (0.4, 0.0)},
        start={"shoulder": (0.0, 0.5), "wrist": (0.0, 0.5)},
    ),
    "point mass": Public(
        _suite("point_mass"),
        {"pointmass.mass": (0.1, 0.6), "root_x.damping": (0.0, 3.0)},
        read={"root_x": 0.0005, "root_y": 0.0005},
        drive={"t1": (1.0, 0.0), "t2": (1.0, 0.0)},
        start={"root_x": (0.0, 0.1), "root_y": (0.0, 0.1)},
    ),
    "inverted double pendulum": Public(
        _gymnasium("inverted_double_pendulum"),
        {"slider.damping": (0.0, 1.0), "hinge.damping": (0.0, 0.3)},
        read={"slider": 0.002, "hinge": 0.005, "hinge2": 0.005},
        drive={"slide": (0.03, 0.0)},
        start={"slider": (0.0, 0.1), "hinge": (pi, 0.5), "hinge2": (0.0, 0.4)},
        seconds=1.5,
    ),
    "swimmer": Public(
        _gymnasium("swimmer"),
        {"motor 1.gear": (75.0, 300.0), "motor1_rot.damping": (0.0, 40.0)},
        read={"free_body_rot": 0.005, "motor1_rot": 0.005, "motor2_rot": 0.005},
        drive={"motor 1": (0.3, 0.0), "motor 2": (0.3, 0.0)},
        start={"motor1_rot": (0.0, 0.1), "motor2_rot": (0.0, 0.1)},
        seconds=3.0,
    ),
    "pusher": Public(
        _gymnasium("pusher_v5"),
        {
            "r_shoulder_lift_joint.damping": (0.3, 3.0),
            "r_elbow_flex_joint.damping": (0.03, 0.5),
        },
        read={f"r_{joint}_joint": 0.005 for joint in PUSHER},
        drive={
            f"motor {k}": (size, 0.0)
            for k, size in enumerate((1.0, 0.6, 0.3, 0.3, 0.1, 0.1, 0.05), 1)
        },
        start={
            "r_shoulder_lift_joint": (0.4, 0.2),
            "r_elbow_flex_joint": (-1.2, 0.2),
            "r_wrist_flex_joint": (-0.5, 0.1),
        },
        seconds=1.0,
    ),
    "Go2 leg": Public(
        go2_leg,
        {
            "FL_thigh_joint.damping": (0.0, 4.0),
            "FL_calf_joint.damping": (0.0, 4.0),
            "FL_calf_joint.armature": (0.0, 0.3),
        },
        read={f"FL_{joint}_joint": 0.002 for joint in LEG},
        drive={"FL_hip": (0.4, 0.0), "FL_thigh": (0.4, 0.9), "FL_calf": (0.6, -1.8)},
        start={
            "FL_hip_joint": (0.0, 0.1),
            "FL_thigh_joint": (0.9, 0.1),
            "FL_calf_joint": (-1.8, 0.1),
        },
    ),
    "servo": Public(
        _servo,
        {"hinge.damping": (0.0, 0.1), "hinge.armature": (0.0005, 0.005)},
        read={"hinge": 0.002},
        drive={"servo": (1.2, 0.0)},
        start={"hinge": (0.0, 0.5)},
    ),
}

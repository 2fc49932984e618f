"""Robots whose logs are simulated with known parameters, and what they lack.

A set is a robot with parameters of its own, its logs, and errors of one of the
conditions: white noise, noise of first-order autocorrelation (.9 or .98 from sample to
sample), or white noise beside dry friction on every driven joint, which the model that
is fitted does not have.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.robots.models import ARM, CART_POLE, SPRING_MASS
from sbi_active.mujoco.models.spec import mujoco_of

Array = NDArray[Any]

#: Correlation from sample to sample, and dry friction in units of the robot's own.
CONDITIONS = {
    "white": (0.0, 0.0),
    "AR .9": (0.9, 0.0),
    "AR .98": (0.98, 0.0),
    "friction .3": (0.0, 0.3),
    "friction 1": (0.0, 1.0),
}
#: Where the files of a robot leg in air are, beside the project.
GO2 = Path(__file__).parents[2] / "../shared/data/go2_in_air/go2_in_air.xml"
#: Sines of a control, and the frequencies that they may have, Hz.
NUM_SINES, FREQUENCIES = 3, (0.3, 2.0)


@dataclass(frozen=True)
class Unknown:
    """A parameter: the box of its prior, where truths are drawn, and how it is set."""

    low: float
    high: float
    inner: tuple[float, float]
    edit: Callable[[Any, str, float], None]
    name: str


@dataclass(frozen=True)
class Machine:
    """A robot that is driven by sines.

    Attributes:
        spec: Makes an ``MjSpec``.
        unknown: Parameters by name.
        drive: Amplitude and center of each actuator's control.
        start: Half width of the uniform start of each joint.
        noise: Standard deviation of each sensor.
        rough: Joints that have dry friction, and its unit, N or N m.
        num: Logs of a set.
        seconds: Length of a log.
        every: Steps from sample to sample.
    """

    spec: Callable[[], Any]
    unknown: dict[str, Unknown]
    drive: tuple[tuple[float, float], ...]
    start: tuple[float, ...]
    noise: tuple[float, ...]
    rough: tuple[tuple[str, ...], float]
    num: int = 4
    seconds: float = 3.0
    every: int = 1


@dataclass(frozen=True)
class Set:
    """What was recorded, and the truth.

    Attributes:
        sequences: ``ModelSequences`` with the spec that is fitted.
        params: ``ParameterDict``, values at the middles of the boxes.
        truth: Shape (d,).
    """

    sequences: Any
    params: Any
    truth: Array


def recorded(machine: Machine, condition: str, seed: int) -> Set:
    """Return one set of logs.

    Args:
        machine: The robot.
        condition: One of :data:`CONDITIONS`.
        seed: Of truths, controls, starts and errors; white and correlated sets of one
            seed share the first three.
    """
    mujoco = mujoco_of()
    from mujoco import sysid  # pyright: ignore

    correlation, friction = CONDITIONS[condition]
    rng = np.random.default_rng([seed, 11])
    spec, true = machine.spec(), machine.spec()
    truth, params = [], sysid.ParameterDict()
    for name, own in machine.unknown.items():
        truth.append(rng.uniform(*own.inner))
        own.edit(true, own.name, truth[-1])

        def modifier(spec: Any, given: Any, own: Unknown = own) -> None:
            own.edit(spec, own.name, float(given.value[0]))

        middle = 0.5 * (own.low + own.high)
        params.add(sysid.Parameter(name, middle, own.low, own.high, modifier=modifier))
    joints, unit = machine.rough
    for joint in joints:
        true.joint(joint).frictionloss = friction * unit
    model = true.compile()
    data = mujoco.MjData(model)
    home = data.qpos.copy()
    times = np.arange(0.0, machine.seconds, model.opt.timestep)
    parts: tuple[list[Any], ...] = ([], [], [])
    for _ in range(machine.num):
        control = sines(times, machine.drive, rng)
        data.qpos[:] = home + np.array(machine.start) * rng.uniform(-1, 1, model.nq)
        start = sysid.create_initial_state(model, data.qpos, 0 * data.qvel, data.act)
        state, sensor = mujoco.rollout.rollout(
            model, mujoco.MjData(model), start, control[:-1]
        )
        read = sensor[0, :: machine.every].copy()
        errors = _errors(read.shape, correlation, rng)
        read += errors * np.array(machine.noise)
        stamps = state[0, :: machine.every, 0]
        parts[0].append(start)
        parts[1].append(sysid.TimeSeries(times, control))
        parts[2].append(sysid.TimeSeries.from_names(stamps, read, model, None))
    names = [f"log {k}" for k in range(machine.num)]
    sequences = sysid.ModelSequences("robot", spec, names, *parts)
    return Set(sequences, params, np.array(truth))


def sines(
    times: Array, drive: Iterable[tuple[float, float]], rng: np.random.Generator
) -> Array:
    """Return controls, shape (steps, actuators), within their amplitudes."""
    found = []
    for size, center in drive:
        frequency = rng.uniform(*FREQUENCIES, NUM_SINES)
        phase = rng.uniform(0, 2 * np.pi, NUM_SINES)
        share = rng.dirichlet(np.ones(NUM_SINES)) * rng.uniform(0.4, 1.0)
        angle = 2 * np.pi * frequency * times[:, None] + phase
        found.append(center + size * np.sin(angle) @ share)
    return np.stack(found, 1)


def _errors(
    shape: tuple[int, ...], correlation: float, rng: np.random.Generator
) -> Array:
    """Return errors of unit variance, shape (samples, sensors)."""
    errors = rng.standard_normal(shape)
    for k in range(1, len(errors)):
        fresh = np.sqrt(1 - correlation**2) * errors[k]
        errors[k] = correlation * errors[k - 1] + fresh
    return errors


# What is written.


def _from(text: str) -> Any:
    return mujoco_of().MjSpec.from_string(text)


def _damping(spec: Any, name: str, value: float) -> None:
    joint = spec.joint(name)
    joint.damping = value + 0.0 * np.asarray(joint.damping)


def _armature(spec: Any, name: str, value: float) -> None:
    spec.joint(name).armature = value


def _mass(spec: Any, name: str, value: float) -> None:
    spec.body(name).first_geom().mass = value


def _gear(spec: Any, name: str, value: float) -> None:
    spec.actuator(name).gear[0] = value


READ_ARM = """<sensor><jointpos name="shoulder" joint="shoulder"/>
<jointpos name="elbow" joint="elbow"/></sensor></mujoco>"""


def shipped(package: str, path: str) -> Any:
    """Return a spec that ships with a package, its actuators named.

    Args:
        package: Name of an installed one, which is not imported.
        path: Of the MJCF within it.
    """
    found = find_spec(package)
    if found is None or found.origin is None:
        raise ImportError(f"needs {package}; run pip install {package}")
    spec = mujoco_of().MjSpec.from_file(str(Path(found.origin).parent / path))
    for number, actuator in enumerate(spec.actuators):
        if not actuator.name:
            actuator.name = f"motor {number + 1}"
    return spec


def swimmer() -> Any:
    """Return gymnasium's swimmer, three links that float in a viscous medium."""
    spec = shipped("gymnasium", "envs/mujoco/assets/swimmer.xml")
    _read_joints(spec)
    return spec


def reacher() -> Any:
    """Return dm_control's reacher, two links in a horizontal plane."""
    spec = shipped("dm_control", "suite/reacher.xml")
    _read_joints(spec)
    return spec


def go2_leg() -> Any:
    """Return the front left leg of a Go2 with its drives, Kp 20 and Kd 1.5."""
    mujoco = mujoco_of()
    spec = mujoco.MjSpec.from_file(str(os.environ.get("GO2_IN_AIR", GO2)))
    for motor in [*spec.actuators]:
        if not motor.name.startswith("FL"):
            spec.delete(motor)
    for joint in [*spec.joints]:
        if not joint.name.startswith("FL") and joint.name.endswith("hip_joint"):
            spec.delete(joint.parent)
    for motor in spec.actuators:
        motor.set_to_position(kp=20.0, kv=1.5)
        motor.forcerange, motor.ctrlrange = motor.ctrlrange.copy(), [-8.0, 8.0]
    _read_joints(spec)
    spec.option.timestep = 0.002
    return spec


def _read_joints(spec: Any) -> None:
    mujoco = mujoco_of()

    for joint in spec.joints:
        spec.add_sensor(
            name=f"read {joint.name}",
            type=mujoco.mjtSensor.mjSENS_JOINTPOS,
            objtype=mujoco.mjtObj.mjOBJ_JOINT,
            objname=joint.name,
        )


MACHINES = {
    "spring-mass": Machine(
        partial(_from, SPRING_MASS),
        {
            "mass": Unknown(0.3, 3.0, (0.7, 1.6), _mass, "cart"),
            "damping": Unknown(0.0, 5.0, (0.4, 2.0), _damping, "slide"),
        },
        drive=((5.0, 0.0),),
        start=(0.2,),
        noise=(0.005, 0.02),
        rough=(("slide",), 1.0),
    ),
    "cart-pole": Machine(
        partial(_from, CART_POLE),
        {
            "mass": Unknown(0.3, 3.0, (0.7, 1.6), _mass, "cart"),
            "damping": Unknown(0.0, 5.0, (0.4, 2.0), _damping, "slide"),
            "pole damping": Unknown(0.0, 0.05, (0.002, 0.02), _damping, "hinge"),
        },
        drive=((2.5, 0.0),),
        start=(0.1, 0.5),
        noise=(0.005, 0.01),
        rough=(("slide",), 1.0),
    ),
    "two-link arm": Machine(
        partial(_from, ARM.replace("</mujoco>", READ_ARM)),
        {
            "lower mass": Unknown(0.1, 2.0, (0.3, 0.9), _mass, "lower"),
            "elbow damping": Unknown(0.0, 3.0, (0.2, 1.2), _damping, "elbow"),
            "elbow armature": Unknown(0.0, 0.2, (0.01, 0.08), _armature, "elbow"),
        },
        drive=((0.6, 0.4), (0.8, 0.5)),
        start=(0.2, 0.2),
        noise=(0.003, 0.003),
        rough=(("shoulder", "elbow"), 0.5),
        every=2,
    ),
    "Go2 leg": Machine(
        go2_leg,
        {
            "thigh damping": Unknown(0.0, 4.0, (0.2, 1.5), _damping, "FL_thigh_joint"),
            "calf damping": Unknown(0.0, 4.0, (0.2, 1.5), _damping, "FL_calf_joint"),
            "calf armature": Unknown(0.0, 0.3, (0.01, 0.1), _armature, "FL_calf_joint"),
        },
        drive=((0.4, 0.0), (0.4, 0.9), (0.6, -1.8)),
        start=(0.0, 0.0, 0.0),
        noise=(0.002, 0.002, 0.002),
        rough=(("FL_hip_joint", "FL_thigh_joint", "FL_calf_joint"), 1.0),
        num=4,
        seconds=2.0,
        every=5,
    ),
    "swimmer": Machine(
        swimmer,
        {
            "gear": Unknown(75.0, 300.0, (100.0, 200.0), _gear, "motor 1"),
            "damping": Unknown(0.0, 40.0, (2.0, 12.0), _damping, "motor1_rot"),
            "armature": Unknown(0.0, 10.0, (0.2, 3.0), _armature, "motor1_rot"),
        },
        drive=((0.3, 0.0), (0.3, 0.0)),
        start=(0.0, 0.0, 0.0, 0.1, 0.1),
        noise=(0.005, 0.005, 0.005, 0.005, 0.005),
        rough=(("motor1_rot", "motor2_rot"), 10.0),
        every=2,
    ),
    "reacher": Machine(
        reacher,
        {
            "shoulder damping": Unknown(0.0, 0.05, (0.005, 0.02), _damping, "shoulder"),
            "hand mass": Unknown(0.01, 0.2, (0.02, 0.08), _mass, "hand"),
            "wrist armature": Unknown(0.0, 1e-3, (1e-4, 5e-4), _armature, "wrist"),
        },
        drive=((0.6, 0.0), (0.4, 0.0)),
        start=(0.5, 0.5),
        noise=(0.005, 0.005),
        rough=(("shoulder", "wrist"), 0.006),
    ),
}

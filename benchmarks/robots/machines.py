"""Robots whose logs are simulated with known parameters, and what they lack.

A set is a robot with parameters of its own, its logs, and errors of one of the
conditions: white noise, noise of first-order autocorrelation (.9 or .98 from sample to
sample), or white noise beside dry friction on every driven joint, which the model that
is fitted does not have.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.robots.models import MJCF
from benchmarks.rows import toml
from sbi_active.mujoco.models.spec import mujoco

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
NUM_LOGS = 4  # of a set


@dataclass(frozen=True)
class Unknown:
    """A parameter.

    Attributes:
        field: What it is: damping or armature of a joint, mass of a body, gear.
        name: Name of the joint, the body or the actuator.
        box: Ends of its prior.
        inner: Ends between which truths are drawn.
    """

    field: str
    name: str
    box: tuple[float, float]
    inner: tuple[float, float]

    def edit(self, spec: Any, value: float) -> None:
        """Set it."""
        if self.field == "gear":
            spec.actuator(self.name).gear[0] = value
        elif self.field == "mass":
            spec.body(self.name).first_geom().mass = value
        else:
            joint = spec.joint(self.name)
            shape = 0.0 * np.asarray(getattr(joint, self.field))
            setattr(joint, self.field, value + shape)


@dataclass(frozen=True)
class Machine:
    """A robot that is driven by sines.

    Attributes:
        mjcf: Its MJCF, as :func:`spec_of` takes it.
        unknown: Parameters by name.
        drive: Amplitude and center of each actuator's control.
        start: Half width of the uniform start of each joint.
        noise: Standard deviation of each sensor.
        rough: Joints that have dry friction.
        friction: Its unit, N or N m.
        seconds: Length of a log.
        every: Steps from sample to sample.
    """

    mjcf: str
    unknown: dict[str, Unknown]
    drive: Sequence[tuple[float, float]]
    start: Sequence[float]
    noise: Sequence[float]
    rough: Sequence[str]
    friction: float
    seconds: float
    every: int

    def spec(self) -> Any:
        """Return an ``MjSpec`` with sensors, of the joints where it has none."""
        spec = spec_of(self.mjcf)
        if not spec.sensors:
            _read_joints(spec)
        return spec


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
    from mujoco import sysid  # pyright: ignore

    correlation, friction = CONDITIONS[condition]
    rng = np.random.default_rng([seed, 11])
    spec, true = machine.spec(), machine.spec()
    truth, params = [], sysid.ParameterDict()
    for name, own in machine.unknown.items():
        truth.append(rng.uniform(*own.inner))
        own.edit(true, truth[-1])

        def modifier(spec: Any, given: Any, own: Unknown = own) -> None:
            own.edit(spec, float(given.value[0]))

        middle = 0.5 * sum(own.box)
        params.add(sysid.Parameter(name, middle, *own.box, modifier=modifier))
    for joint in machine.rough:
        true.joint(joint).frictionloss = friction * machine.friction
    model = true.compile()
    data = mujoco.MjData(model)
    home = data.qpos.copy()
    times = np.arange(0.0, machine.seconds, model.opt.timestep)
    parts: tuple[list[Any], ...] = ([], [], [])
    for _ in range(NUM_LOGS):
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
    names = [f"log {k}" for k in range(NUM_LOGS)]
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


def spec_of(mjcf: str) -> Any:
    """Return a spec: of a package and a path in it, of ``mjcf``, or the Go2's leg."""
    package, _, path = mjcf.partition(" ")
    if path:
        return shipped(package, path)
    if mjcf == "go2":
        return go2_leg()
    return mujoco.MjSpec.from_file(str(MJCF / f"{mjcf}.xml"))


def shipped(package: str, path: str) -> Any:
    """Return a spec that ships with a package, its actuators named.

    Args:
        package: Name of an installed one, which is not imported.
        path: Of the MJCF within it.
    """
    found = find_spec(package)
    if found is None or found.origin is None:
        raise ImportError(f"needs {package}; run pip install {package}")
    spec = mujoco.MjSpec.from_file(str(Path(found.origin).parent / path))
    for number, actuator in enumerate(spec.actuators):
        if not actuator.name:
            actuator.name = f"motor {number + 1}"
    return spec


def go2_leg() -> Any:
    """Return the front left leg of a Go2 with its drives, Kp 20 and Kd 1.5."""
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
    for joint in spec.joints:
        spec.add_sensor(
            name=f"read {joint.name}",
            type=mujoco.mjtSensor.mjSENS_JOINTPOS,
            objtype=mujoco.mjtObj.mjOBJ_JOINT,
            objname=joint.name,
        )


def _machine(*, unknown: dict[str, Any], **row: Any) -> Machine:
    each = {name: Unknown(**own) for name, own in unknown.items()}
    return Machine(unknown=each, **row)


ROWS = toml(Path(__file__).with_suffix(".toml"))
MACHINES = {name: _machine(**row) for name, row in ROWS.items()}

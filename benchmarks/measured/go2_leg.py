"""One leg of the Go2: its record in triangles, its model, free runs of the record."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sbi_active.criticism import AugmentedSimulator, Effect
from sbi_active.criticism.rivals.trial_simulator import conditions_of_trials
from sbi_active.mujoco import from_mjcf
from sbi_active.mujoco.models.spec import mujoco
from sbi_active.mujoco.robot import Robot
from sbi_active.simulation import AutocorrelatedNoise

Array = NDArray[Any]

DATA = Path("../shared/data/go2_in_air")
LEGS = ("FL", "FR", "RL", "RR")
JOINTS = ("hip", "thigh", "calf")
#: First sample of each triangle; the first eight are fitted.
FIRST = (0, 601, 1163, 1684, 2165, 2606, 3008, 3370, 3692, 3973, 4215, 4415, 4576)
FITTED = 8
KP, KD = 20.0, 1.5  # N m/rad and N m s/rad, of the drive
PERIOD = 0.005  # s
STEPS = 2  # of the simulation in a period
EVERY = 5  # readings that are fitted by the loop: what it gets wrong is smooth
#: Samples to each side from which the speed at a triangle's start is read.
AROUND = 4
#: Encoder, rad: a jitter of .25 ms of its time at the speeds of the fitted triangles.
ENCODER_SD = 5e-4
#: What the simulator gets wrong, rad, and the time over which it does, s.
SD, CORRELATION_TIME = (1e-3, 0.2), (0.01, 3.0)
#: Lets dry friction hold: with MuJoCo's default a joint that is held creeps.
SOLREF, SOLIMP = (0.005, 1.0), (0.99, 0.999, 0.001, 0.5, 2.0)


#: Bounds: of a rotor, kg m^2; of damping, N m s/rad; of dry friction, N m; of the
#: motor's torque, as a multiple of what the drive believes.
ARMATURE, DAMPING, FRICTION, SCALE = (0.0, 0.1), (0.0, 1.0), (0.0, 2.0), (0.4, 2.0)


@dataclass(frozen=True)
class Leg:
    """A leg's record.

    Attributes:
        name: As in "FL".
        folder: Of the MJCF.
        time: Shape (n,), s.
        goal: Shape (n, 3), rad.
        position: Measured, shape (n, 3), rad.
    """

    name: str
    folder: Path
    time: Array
    goal: Array
    position: Array

    @property
    def joints(self) -> list[str]:
        """Names of its joints."""
        return [f"{self.name}_{joint}_joint" for joint in JOINTS]

    @property
    def motors(self) -> list[str]:
        """Names of its motors."""
        return [f"{self.name}_{joint}" for joint in JOINTS]

    @property
    def split(self) -> int:
        """Number of samples of the triangles that are fitted."""
        return FIRST[FITTED]

    def spec(self) -> Any:
        """Return its MJCF: the leg alone, rigid, its motors driven by the PD law."""
        spec = mujoco.MjSpec.from_file(str(self.folder / "go2_in_air.xml"))
        for key in [*spec.keys]:
            spec.delete(key)
        for motor in [*spec.actuators]:
            if motor.name not in self.motors:
                spec.delete(motor)
                continue
            most = float(motor.ctrlrange[1])
            motor.set_to_position(kp=KP, kv=KD)
            motor.forcerange, motor.ctrlrange = [-most, most], [-4.0, 4.0]
        for other in LEGS:
            if other != self.name:
                spec.delete(spec.body(f"{other}_hip"))
        for joint in spec.joints:
            joint.solref_friction, joint.solimp_friction = SOLREF, SOLIMP
        spec.option.timestep = PERIOD / STEPS
        return spec

    def log(self, begin: int, end: int, every: int = 1) -> dict[str, Array]:
        """Return some samples as a recording, from the state at the first.

        The speed is the slope of a line through the readings around it.

        Args:
            begin: First sample.
            end: The one behind the last.
            every: Readings that are kept; the goals all are.
        """
        rows = slice(begin, end)
        log: dict[str, Array] = {"time": self.time[rows] - self.time[begin]}
        near = slice(max(begin - AROUND, 0), begin + AROUND + 1)
        slopes = np.polyfit(self.time[near], self.position[near], 1)[0]
        names = zip(self.joints, self.motors, strict=True)
        for k, (joint, motor) in enumerate(names):
            log[motor] = self.goal[rows, k]
            read = np.arange(end - begin) % every == 0
            log[joint] = np.where(read, self.position[rows, k], np.nan)
            log[f"start {joint}"] = np.full(end - begin, self.position[begin, k])
            log[f"start {joint} velocity"] = np.full(end - begin, slopes[k])
        return log

    def robot(
        self, parameters: Mapping[str, Any], logs: Sequence[dict[str, Array]]
    ) -> Robot:
        """Return simulator, prior and trials.

        Args:
            parameters: Of ``from_mjcf``.
            logs: Of :meth:`log`.
        """
        noise = AutocorrelatedNoise.unknown(
            sd=SD, correlation_time=CORRELATION_TIME, measurement_sd=ENCODER_SD
        )
        return from_mjcf(
            self.spec(), parameters, sensors=self.joints, recordings=logs, noise=noise
        )

    def triangles(self) -> list[dict[str, Array]]:
        """Return the logs of the triangles that are fitted."""
        ends = FIRST[1 : FITTED + 1]
        pairs = zip(FIRST[:FITTED], ends, strict=True)
        return [self.log(begin, end, EVERY) for begin, end in pairs]

    def free_run(
        self,
        parameters: Mapping[str, Any],
        effects: Sequence[Effect],
        values: Tensor,
    ) -> Array:
        """Return the record from its first reading on, shape (n, samples, 3).

        Args:
            parameters: Of ``from_mjcf``.
            effects: That the simulator has.
            values: Theta and strengths of the effects, shape (n, d).
        """
        robot = self.robot(parameters, [self.log(0, len(self.time))])
        sizes = [len(parameters), *[effect.phi_dim for effect in effects]]
        theta, *phi = values.double().split(sizes, 1)
        model = AugmentedSimulator(robot.simulator, [*effects])
        assert robot.trials is not None
        num = len(values)
        rows = torch.zeros(num, dtype=torch.long)
        x = model.evaluate(
            theta,
            {e.name: p for e, p in zip(effects, phi, strict=True)},
            robot.trials.action.double().expand(num, -1),
            context=conditions_of_trials(robot.trials, rows, robot.simulator),
        )
        return x.numpy()

    def errors(self, x: Array) -> dict[str, list[float]]:
        """Return the RMSE by joint, rad, of the fitted and of the faster triangles.

        Args:
            x: A free run, shape (samples, 3).
        """
        square = (x - self.position) ** 2
        parts = {"fitted": square[: self.split], "held out": square[self.split :]}
        return {k: np.sqrt(part.mean(0)).tolist() for k, part in parts.items()}


@dataclass(frozen=True)
class _TorqueScale:
    """Multiplies the torque of a motor, as ``edit(spec, value)``."""

    motor: str

    def __call__(self, spec: Any, value: float) -> None:
        motor = spec.actuator(self.motor)
        limits = motor.forcerange.copy(), motor.ctrlrange.copy()
        motor.set_to_position(kp=KP * value, kv=KD * value)
        motor.forcerange, motor.ctrlrange = limits


def usual_parameters(leg: Leg) -> dict[str, Any]:
    """Return what an engineer fits: armature, damping, dry friction, torque scale."""
    found: dict[str, Any] = {f"{j}.armature": ARMATURE for j in leg.joints}
    found |= {f"{j}.damping": DAMPING for j in leg.joints}
    found |= {f"{j}.frictionloss": FRICTION for j in leg.joints}
    return found | {f"{m} torque scale": (*SCALE, _TorqueScale(m)) for m in leg.motors}


def read_leg(folder: str | Path, name: str) -> Leg:
    """Return the record of a leg.

    Args:
        folder: With ``go2_in_air.xml`` and ``trajectory.csv``.
        name: As in "FL".

    Raises:
        FileNotFoundError: If a file is missing.
    """
    folder = Path(folder)
    for file in ("go2_in_air.xml", "trajectory.csv"):
        if not (folder / file).is_file():
            raise FileNotFoundError(
                f"expected {file} in {folder}; got none; pass the folder of go2_in_air"
            )
    path = folder / "trajectory.csv"
    names = path.read_text().partition("\n")[0].strip().split(",")
    rows = np.genfromtxt(path, delimiter=",", skip_header=1)
    table = dict(zip(names, rows.T, strict=True))
    goal, position = (
        np.stack([table[f"{what}_{name}_{joint}"] for joint in JOINTS], 1)
        for what in ("goal", "q")
    )
    # The clock is nominal: 200 Hz.
    return Leg(name, folder, PERIOD * np.arange(len(rows)), goal, position)

"""Actions that keep a robot within its limits, by simulating them first."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.arrays import Array
from sbi_active.expected import require
from sbi_active.mujoco.models.machine import Machine
from sbi_active.mujoco.models.names import names_of, require_name, scalar_joints
from sbi_active.mujoco.robot import Robot
from sbi_active.mujoco.sensors import AddedSensor, channels_of
from sbi_active.mujoco.simulator import MujocoFunction
from sbi_active.seeding import forked_generators
from sbi_active.simulation import SimulatorModel

#: Readings of all rows that are in memory at once.
NUMBERS = 20_000_000


class MotionLimits:
    """A constraint on actions: joints and actuators stay within limits when played.

    Passed as ``constraint=`` to a :class:`.Campaign` or a designer, it permits actions
    whose motion, simulated at draws from the belief, stays within every limit at each
    step, and in which no state diverges. The draws are few and the model is not the
    robot: leave a margin, and keep the robot's own guards.

    Args:
        robot: Robot of :func:`.from_mjcf` or :func:`.from_sysid`.
        position: Limits (low, high) by joint, rad or m; None takes the ranges of those
            joints that are limited in the MJCF. ``{}`` for none.
        velocity: Largest speed by joint, rad/s or m/s.
        torque: Largest force by actuator, N m or N, of the actuator's own; None takes
            the ``forcerange`` of the MJCF where it has one.
        belief: Belief over the parameters; None takes the prior.
        num_draws: Number of draws of the parameters. The first one already refuses
            most.
        seed: Seed of the draws.

    Raises:
        ValueError: If a name does not exist, a limit is not positive or empty, or there
            is no limit at all.

    Example:
        >>> from sbi_active import DiscreteActions
        >>> from sbi_active.mujoco import from_mjcf
        >>> robot = from_mjcf(
        ...     '''<mujoco><worldbody><body><joint name="hinge" axis="0 1 0"/><geom
        ...     type="capsule" fromto="0 0 0 0 0 -.5" size=".02" mass="1"/></body>
        ...     </worldbody></mujoco>''',
        ...     {"hinge.damping": (0.0, 0.1)}, sensors=["hinge"], noise=0.01,
        ...     times=[1.0], actions=DiscreteActions([0.2, 1.5], names=["hinge"]))
        >>> limits = MotionLimits(robot, position={"hinge": (-1.0, 1.0)})
        >>> limits(torch.tensor([[0.2], [1.5]]))
        tensor([ True, False])
        >>> sorted(limits.extremes(torch.tensor([[0.2]])))
        ['hinge']
    """

    def __init__(
        self,
        robot: Robot,
        *,
        position: Mapping[str, tuple[float, float]] | None = None,
        velocity: Mapping[str, float] | None = None,
        torque: Mapping[str, Any] | None = None,
        belief: Distribution | None = None,
        num_draws: int = 8,
        seed: int = 0,
    ) -> None:
        function: MujocoFunction = robot.simulator.fn  # pyright: ignore
        model = function.model
        if position is None:
            position = _ranges(model, "joint", model.jnt_limited, model.jnt_range)
        if torque is None:
            own = model.actuator_forcelimited, model.actuator_forcerange
            torque = _ranges(model, "actuator", *own)
        joints, actuators = scalar_joints(model), names_of(model, "actuator")
        watched = {
            **_watched(position, joints, "", "position"),
            **_watched(velocity or {}, joints, " velocity", "velocity"),
            **_watched(torque, actuators, " torque", "force"),
        }
        if not watched:
            raise ValueError(
                "expected limits of positions, velocities or torques; got none, nor "
                "has the MJCF; pass, say, position={'hinge': (-1.0, 1.0)}"
            )
        self._labels = [*watched]
        self._low, self._high = np.array([ends for _, ends in watched.values()]).T
        self._run = _with_sensors(
            robot.simulator, [edit for edit, _ in watched.values()]
        )
        self._times = _every_step(robot.simulator, model.opt.timestep)
        with forked_generators(seed):
            self._theta = (belief or robot.prior).sample((num_draws,)).double()

    def __call__(self, action: Tensor) -> Tensor:
        """Return a mask of actions (n, action_dim) within all limits, bool (n,)."""
        action = torch.as_tensor(action).double()
        inside = np.ones(len(action), dtype=bool)
        # Most that leave their limits do so at any parameters.
        for theta in (self._theta[:1], self._theta[1:]):
            place = np.flatnonzero(inside)
            if not len(place) or not len(theta):
                break
            low, high = self._reached(action[place], theta)
            within = (low >= self._low) & (high <= self._high)  # no for NaN
            inside[place] = within.all(1)
        return torch.from_numpy(inside)

    def extremes(self, action: Tensor) -> dict[str, tuple[Array, Array]]:
        """Return the lowest and highest value of what is limited, over all draws.

        Args:
            action: Actions, shape (n, action_dim).

        Returns:
            Both of shape (n,), by the name of a joint, a joint with " velocity", or an
            actuator with " torque"; NaN where a state diverges.
        """
        low, high = self._reached(torch.as_tensor(action).double(), self._theta)
        return {label: (low[:, k], high[:, k]) for k, label in enumerate(self._labels)}

    def _reached(self, action: Tensor, theta: Tensor) -> tuple[Array, Array]:
        """Return lowest and highest readings, each of shape (n, limits)."""
        num = len(theta)
        size = max(1, NUMBERS // (num * len(self._times) * len(self._labels)))
        lows, highs = [], []
        for some in action.split(size):
            rows = theta.repeat(len(some), 1), some.repeat_interleave(num, 0)
            times = torch.from_numpy(self._times).expand(len(rows[0]), -1)
            x = self._run(*rows, times=times).double().numpy()
            x = x.reshape(len(some), num * len(self._times), -1)
            lows.append(x.min(1))
            highs.append(x.max(1))
        return np.concatenate(lows), np.concatenate(highs)


def _ranges(
    model: Any, kind: str, is_limited: Any, ranges: Any
) -> dict[str, tuple[float, float]]:
    """Return the ranges of those elements of a model that are limited."""
    every = zip(names_of(model, kind), is_limited, ranges, strict=True)
    return {name: (float(a), float(b)) for name, limited, (a, b) in every if limited}


def _watched(
    limits: Mapping[str, Any], known: Iterable[str], ending: str, what: Any
) -> dict[str, tuple[AddedSensor, tuple[float, float]]]:
    """Return the sensor and the limits of each, by its label."""
    found = {}
    for name, limit in limits.items():
        require_name(name, known, "actuator" if what == "force" else "joint")
        label = name + ending
        low, high = map(float, limit if np.ndim(limit) else (-limit, limit))
        require(
            low < high and not (math.isinf(low) and math.isinf(high)),
            f"limits of {label} that leave room",
            limit,
            "pass (low, high), or one positive number for both sides",
        )
        # beside one that the MJCF may have
        found[label] = AddedSensor(f"limit of {label}", name, what), (low, high)
    return found


def _with_sensors(simulator: SimulatorModel, edits: Sequence[Any]) -> SimulatorModel:
    """Return a simulator that reads what is limited, and nothing else."""
    function: MujocoFunction = simulator.fn  # pyright: ignore[reportAssignmentType]
    machines = [
        Machine(m.source.edited(*edits), m.parameters, edit=m.edit)
        for m in function.machines
    ]
    own = copy.copy(function)
    own.machines, own.readout = tuple(machines), None
    own.channels = channels_of(own.model, [edit.name for edit in edits])
    return SimulatorModel(own, inputs=simulator.inputs)


def _every_step(simulator: SimulatorModel, step: float) -> Array:
    """Return the times of all steps of a trial, s, shape (k,)."""
    grids, first = [simulator.sample_times], 0.0
    if simulator.inputs is not None:
        grids.append(simulator.inputs.input_times)
        first = float(simulator.inputs.input_times[0])
    last = max(float(grid.max()) for grid in grids if grid is not None)
    return first + step * np.arange(int((last - first) / step + 1.5))

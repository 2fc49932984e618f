"""MuJoCo models as the function of a simulator."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sbi_active.arrays import Array
from sbi_active.expected import require
from sbi_active.mujoco.models.machine import Machine, Rows
from sbi_active.mujoco.models.names import meaning, names_of, places_of, require_name
from sbi_active.mujoco.models.running import Run, num_steps, sampled
from sbi_active.mujoco.models.spec import mujoco, quiet

#: Numbers of readings, controls and states in memory at once.
NUMBERS = 4_000_000
#: Rows of one length from which they run apart from longer ones, on average: of
#: MuJoCo's rollout, and of those that are stepped together, where few cost as many.
FEWEST = (1, 16)
#: Entry of an action that says which of several models runs.
MODEL = "model"
#: Entry of an action that is the number of a recording.
RECORDING = "recording"


@dataclass(frozen=True)
class Channel:
    """A number that a sensor reads.

    Attributes:
        name: Name in reports.
        place: Place in the model's ``sensordata``.
        unit: Unit in SI, as far as the model tells it.
    """

    name: str
    place: int
    unit: str = ""

    @property
    def label(self) -> str:
        """Name and unit, as in "hinge [rad]"."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name


class MujocoFunction:
    r"""The function ``fn(theta, action, ...)`` of a simulator that runs MuJoCo.

    Entries of an action are the names of joints (a start position), of joints with
    " velocity", of actuators (a control that is held), or "model", the number of the
    model that runs. A name that a joint and an actuator share is the actuator's; the
    joint's start is then "hinge position". Where the action parametrizes signals, or
    trials bring their own, they come as ``inputs``, named by actuators.

    Args:
        machines: Models of one set of parameters.
        channels: Channels that are returned.
        roles: Meaning of each entry of an action; "" for one that only names a trial.
        start: Start states of all trials that do not say, by name: positions,
            velocities, controls that are held ("motor control"), poses of mocap bodies
            ("target mocap[0]" to "target mocap[6]").
        readout: Readout between the model's sensors and what is returned, with
            ``readout.late(theta)``, by how much each channel reads what was there
            before, s, and ``readout.read(x, theta)``, shapes (n, c) and (n, k, c).
        recorded: Model and start states by name, one a recording, where the entry
            "recording" of an action is its number.

    Attributes:
        machines: Models of one set of parameters.
        channels: Channels that are returned.
    """

    def __init__(
        self,
        machines: Sequence[Machine],
        channels: Sequence[Channel],
        *,
        roles: Sequence[str] = (),
        start: Mapping[str, float] | None = None,
        readout: Any = None,
        recorded: Mapping[str, Array] | None = None,
    ) -> None:
        self.readout, self.recorded = readout, dict(recorded or {})
        self.machines, self.channels = tuple(machines), tuple(channels)
        self.roles, self.start = tuple(roles), dict(start or {})

    @property
    def model(self) -> Any:
        """The first model, as compiled."""
        return self.machines[0].model

    @property
    def joints(self) -> tuple[list[str], list[str]]:
        """Names of the joints, and of those that slide; ``force_effects`` asks."""
        names = names_of(self.model, "joint")
        slides = np.flatnonzero(self.model.jnt_type == mujoco.mjtJoint.mjJNT_SLIDE)
        return names, [names[i] for i in slides]

    def __call__(
        self,
        theta: Tensor,
        action: Tensor,
        *,
        times: Tensor,
        inputs: Mapping[str, Tensor] | None = None,
        input_times: Tensor | None = None,
        start: Any = None,
        model: Any = None,
        force: Any = None,
        watch: Callable[[Run], Any] | None = None,
    ) -> Tensor:
        """Return the sensors' readings.

        Args:
            theta: Parameters, shape (n, d).
            action: Actions, shape (n, action_dim).
            times: Times of the readings, shape (n, k).
            inputs: Controls by actuator, shape (n, m), held between their times.
            input_times: Times of the inputs, shape (m,); the simulation starts at the
                first.
            start: Start state by name of a joint, or with " velocity", shape (n,).
            model: Changes of the model, {:class:`.ModelChange`: (n, k)}.
            force: Generalized forces, {:class:`.Force`: (n, k)}.
            watch: Function that is called with the rows that run, before they do.

        Returns:
            Shape (n, k, channels), or (n, k) of a single one; NaN in a row that
            diverged.
        """
        num = len(theta)
        starts = self._starts(start, _array(action), num)
        which = np.rint(starts.pop(MODEL, np.zeros(num))).astype(int)
        known = [*range(len(self.machines))]
        is_known, got = bool(np.isin(which, known).all()), np.unique(which)
        require(is_known, f"models among {known}", got, "correct the action")
        rows = Rows(
            _array(theta),
            _numbers(model),
            _numbers(force),
            starts,
            _numbers(inputs),
            _array(times),
        )
        grid = None if input_times is None else _array(input_times)
        x = np.zeros((*rows.times.shape, len(self.channels)))
        with quiet():
            for k, own in _alike(which, rows.times, FEWEST[rows.is_stepped]):
                self._run(self.machines[k], rows.at(own), grid, watch, x, own)
        found = torch.from_numpy(x[..., 0] if len(self.channels) == 1 else x)
        return found.to(theta.dtype)

    def _run(
        self,
        machine: Machine,
        rows: Rows,
        grid: Array | None,
        watch: Callable[[Run], Any] | None,
        x: Array,
        own: NDArray[np.intp],
    ) -> None:
        """Add the readings of rows to x, at places of their own."""
        base = machine.model
        step, start = base.opt.timestep, 0.0 if grid is None else float(grid[0])
        steps = num_steps(rows.times, start, step)
        width = base.nu + 7 * base.nmocap + base.nsensordata + base.nq + base.nv + 1
        size = max(1, NUMBERS // (steps * width))
        channels = [c.place for c in self.channels]
        for model, models, places, share in machine.batches(rows, size):
            some = rows.at(places)
            run = Run.of(model, models, some, grid, steps)
            if watch is not None:
                watch(run)
            late = None if self.readout is None else self.readout.late(some.theta)
            read = run.readings()[..., channels]
            read = sampled(read, some.times, start, step, late)
            if self.readout is not None:
                read = self.readout.read(read, some.theta)
            x[own[places]] += share[:, None, None] * read

    def _starts(self, start: Any, actions: Array, num: int) -> dict[str, Array]:
        known = [*places_of(self.model), MODEL]
        found = {name: np.full(num, value) for name, value in self.start.items()}
        if RECORDING in self.roles and start is None:
            number = np.rint(actions[:, self.roles.index(RECORDING)]).astype(int)
            found |= {name: value[number] for name, value in self.recorded.items()}
        for role, value in zip(self.roles, actions.T, strict=False):
            name = meaning(role, self.model)
            if name in known:
                found[name] = value
        if start is None:
            return found
        for name, value in start.items():
            require_name(name, known, "joint, or one with ' velocity',")
            found[name] = _array(value)
        return found


def _alike(
    which: Array, times: Array, fewest: int
) -> Iterator[tuple[int, NDArray[np.intp]]]:
    """Yield a model's number and rows that it runs for as long as each other.

    Args:
        which: Model of each row, (n,).
        times: Times of its readings, (n, k).
        fewest: Rows of one length, on average, from which lengths run apart.
    """
    last = times.max(1, initial=0.0)
    for k in np.unique(which):
        mine = np.flatnonzero(which == k)
        lasting = np.unique(last[mine])
        # Recordings differ in length; where every row does, parts would be too small.
        is_few = len(lasting) * fewest > len(mine)
        for length in [None] if is_few else lasting:
            yield int(k), mine if length is None else mine[last[mine] == length]


def _numbers(given: Mapping[Any, Tensor] | None) -> dict[Any, Array]:
    return {key: _array(value) for key, value in (given or {}).items()}


def _array(value: Tensor) -> Array:
    return value.detach().cpu().double().numpy()

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
from sbi_active.mujoco.models.changes import require_changes
from sbi_active.mujoco.models.machine import Machine, Model, Rows
from sbi_active.mujoco.models.names import (
    held_places,
    meaning,
    names_of,
    require_name,
    start_places,
)
from sbi_active.mujoco.models.running import held_states, readings
from sbi_active.mujoco.models.spec import mujoco_of

Watch = Callable[[Model, list[Any], Rows], Any]

#: Numbers of readings, controls and states in memory at once.
NUMBERS = 4_000_000
#: Rows that are stepped together, each with data of its own.
TOGETHER = 64
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
        times: Times of the readings where trials do not say, shape (k,).
        start: Start states of all trials that do not say, by name: positions,
            velocities, controls that are held ("motor control"), poses of mocap bodies
            ("target mocap[0]" to "target mocap[6]").
        threads: Number of threads of MuJoCo's rollout.
        readout: Readout between the model's sensors and what is returned, with
            ``readout.late(theta)``, by how much each channel reads what was there
            before, s, and ``readout.read(x, theta)``, shapes (n, c) and (n, k, c).
        recorded: Model and start states of each recording, where the entry "recording"
            of an action is its number.

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
        times: Array | None = None,
        start: Mapping[str, float] | None = None,
        threads: int = 1,
        readout: Any = None,
        recorded: Sequence[tuple[int, Mapping[str, float]]] = (),
    ) -> None:
        self.readout, self.recorded = readout, tuple(recorded)
        self.machines, self.channels = tuple(machines), tuple(channels)
        self.roles, self.threads = tuple(roles), threads
        self.times, self.start = times, dict(start or {})
        if not isinstance(threads, int) or threads < 1:
            raise ValueError(
                f"expected at least one thread; got threads={threads!r}; pass 1 or more"
            )

    @property
    def model(self) -> Any:
        """The first model, as compiled."""
        return self.machines[0].model

    @property
    def joints(self) -> tuple[list[str], list[str]]:
        """Names of the joints, and of those that slide; ``force_effects`` asks."""
        names = names_of(self.model, "joint")
        slide = int(mujoco_of().mjtJoint.mjJNT_SLIDE)
        slides = [
            n for n, k in zip(names, self.model.jnt_type, strict=True) if k == slide
        ]
        return names, slides

    def __call__(
        self,
        theta: Tensor,
        action: Tensor,
        *,
        inputs: Mapping[str, Tensor] | None = None,
        input_times: Tensor | None = None,
        times: Tensor | None = None,
        start: Any = None,
        model: Any = None,
        force: Any = None,
        watch: Watch | None = None,
    ) -> Tensor:
        """Return the sensors' readings.

        Args:
            theta: Parameters, shape (n, d).
            action: Actions, shape (n, action_dim).
            inputs: Controls by actuator, shape (n, m), held between their times.
            input_times: Times of the inputs, shape (m,); the simulation starts at the
                first.
            times: Times of the readings, shape (n, k).
            start: Start state by name of a joint, or with " velocity", shape (n,).
            model: Changes of the model, {:class:`.ModelChange`: (n, k)}.
            force: Generalized forces, {:class:`.Force`: (n, k)}.
            watch: Function that is called with the rows that run, before they do.

        Returns:
            Shape (n, k, channels), or (n, k) of a single one; NaN in a row that
            diverged.
        """
        num = len(theta)
        actions = action.detach().cpu().double().numpy()
        wanted = self._times(times, num)
        series = {k: _array(u) for k, u in (inputs or {}).items()}
        grid = None if input_times is None else _array(input_times)
        starts = self._starts(start, actions, num)
        which = np.rint(starts.pop(MODEL, np.zeros(num))).astype(int)
        if num and (which.min() < 0 or which.max() >= len(self.machines)):
            raise ValueError(
                f"expected models 0 to {len(self.machines) - 1}; got {which.min()} to "
                f"{which.max()}; correct the action"
            )
        found = np.empty((num, wanted.shape[1], len(self.channels)))
        changes = require_changes("model", model)
        forces = require_changes("force", force)
        begin = 0.0 if grid is None else float(grid[0])
        rows = Rows(_array(theta), changes, forces, starts, np.empty((num, 0)))
        for k, own in _alike(which, wanted - begin, FEWEST[rows.is_stepped]):
            played = {name: u[own] for name, u in series.items()}
            about = rows.at(own), played, grid, wanted[own], watch
            found[own] = self._run(self.machines[k], *about)
        x = torch.from_numpy(found[..., 0] if len(self.channels) == 1 else found)
        return x.to(theta.dtype)

    def _run(
        self,
        machine: Machine,
        rows: Rows,
        series: dict[str, Array],
        grid: Array | None,
        times: Array,
        watch: Watch | None,
    ) -> Array:
        base = machine.model
        step = base.opt.timestep
        begin = 0.0 if grid is None else float(grid[0])
        num = num_steps(times, begin, step)
        width = base.nu + 7 * base.nmocap + base.nsensordata + base.nq + base.nv + 1
        size = max(1, NUMBERS // (num * width))
        if rows.is_stepped:
            size = min(size, TOGETHER)
        numbers = np.arange(len(rows), dtype=float)[:, None]
        places = [c.place for c in self.channels]
        # Controls of all rows may be large: they are made for those that run.
        rows.controls = numbers

        def run(model: Model, models: list[Any], some: Rows) -> Array:
            at = some.controls[:, 0].astype(int)
            default = held_states(model)
            some.controls = self._controls(
                base, default, some.start, series, grid, at, num, step
            )
            if watch is not None:
                watch(model, models, some)
            x = readings(model, models, some, threads=self.threads)
            late = None if self.readout is None else self.readout.late(some.theta)
            x = sampled(x[..., places], times[at], begin, step, late)
            return x if self.readout is None else self.readout.read(x, some.theta)

        return machine.models(rows, run, size)

    def _controls(
        self,
        model: Any,
        default: Array,
        start: dict[str, Array],
        series: dict[str, Array],
        grid: Array | None,
        at: Array,
        num: int,
        step: float,
    ) -> Array:
        """Return controls and poses of mocap bodies, (n, num, nu + 7 nmocap)."""
        controls = np.tile(default, (len(at), num, 1))
        for name, place in held_places(model).items():
            if name in start:
                controls[:, :, place] = start[name][:, None]
        names = names_of(model, "actuator")
        for name, u in series.items():
            require_name(name, names, "actuator")
            assert grid is not None
            controls[:, :, names.index(name)] = held(u[at], grid, num, step)
        return controls

    def _times(self, times: Tensor | None, num: int) -> Array:
        if times is not None:
            return _array(times)
        if self.times is None:
            raise ValueError(
                "expected the times at which sensors are read; got none; pass times= "
                "to from_mjcf, or Trials(sample_times=...)"
            )
        return np.broadcast_to(self.times, (num, len(self.times)))

    def _starts(self, start: Any, actions: Array, num: int) -> dict[str, Array]:
        known = {*start_places(self.model), *held_places(self.model), MODEL}
        found = {name: np.full(num, value) for name, value in self.start.items()}
        if RECORDING in self.roles and start is None:
            number = np.rint(actions[:, self.roles.index(RECORDING)]).astype(int)
            each = [{MODEL: k, **values} for k, values in self.recorded]
            for name in each[0]:
                found[name] = np.array([own[name] for own in each])[number]
        for role, value in zip(self.roles, actions.T, strict=False):
            name = meaning(role, self.model)
            if name in known:
                found[name] = value
        if start is None:
            return found
        if not isinstance(start, Mapping):
            raise ValueError(
                "expected start states by the names of joints; got an array; pass "
                "Trials(start={'hinge': angles})"
            )
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
        times: Times of its readings since the start, (n, k).
        fewest: Rows of one length, on average, from which lengths run apart.
    """
    last = np.nanmax(times, 1, initial=0.0)
    for k in np.unique(which):
        mine = np.flatnonzero(which == k)
        lasting = np.unique(last[mine])
        # Recordings differ in length; where every row does, parts would be too small.
        if len(lasting) * fewest > len(mine):
            yield int(k), mine
            continue
        for length in lasting:
            yield int(k), mine[last[mine] == length]


def _array(value: Tensor) -> Array:
    return value.detach().cpu().double().numpy()


#: Share of a step by which a time may be off and count as that of a step.
ON_TIME = 1e-3


def num_steps(times: Array, start: float, step: float) -> int:
    """Return the number of readings, one a step from the start, up to the last time."""
    last = float(np.nanmax(times)) - start
    return max(int(np.ceil(last / step - ON_TIME)), 0) + 1


def held(series: Array, own: Array, num: int, step: float) -> Array:
    """Return a series (n, m), held between the points of its grid, at every step.

    Args:
        series: Series, shape (n, m).
        own: Grid of the series, shape (m,).
        num: Number of steps from the grid's first point.
        step: Time step of the simulation.
    """
    times = own[0] + step * np.arange(num)
    slack = ON_TIME * min(step, own[1] - own[0])
    place = np.searchsorted(own, times + slack, side="right") - 1
    return series[:, np.clip(place, 0, len(own) - 1)]


def sampled(
    readings: Array,
    times: Array,
    start: float,
    step: float,
    late: Array | None = None,
) -> Array:
    """Return readings at times, a line between those of two steps.

    Args:
        readings: Readings, shape (n, steps, c), from the start on.
        times: Times, shape (n, k).
        start: Time of the first reading.
        step: Time between readings.
        late: Delay of each channel, (n, c); None is 0.

    Returns:
        Shape (n, k, c).
    """
    if late is not None:
        each = [
            sampled(readings[..., [c]], times - late[:, [c]], start, step)
            for c in range(readings.shape[2])
        ]
        return np.concatenate(each, 2)
    last = readings.shape[1] - 1
    place = np.clip((times - start) / step, 0, last)
    nearest = np.round(place)
    place = np.where(np.abs(place - nearest) < ON_TIME, nearest, place)
    low = np.floor(place).astype(int)
    weight = (place - low)[..., None]
    high = np.minimum(low + 1, last)
    row = np.arange(len(readings))[:, None]
    found = readings[row, low]
    between = weight[..., 0] > 0
    if between.any():
        line = (1 - weight) * found + weight * readings[row, high]
        found = np.where(between[..., None], line, found)
    return found

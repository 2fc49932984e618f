"""Rows of a machine, stepped: what its sensors read at every step.

Without forces of a caller, or changes that follow the state, MuJoCo's own rollout runs
each row to its end. With them all rows go step by step together, so that a force is
computed once a step for all.

A sensor's reading belongs to the state before a step: reading k is at time k h.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from sbi_active.arrays import Array
from sbi_active.mujoco.models.changes import StateChange
from sbi_active.mujoco.models.machine import Model, Rows
from sbi_active.mujoco.models.names import element_id, physics_size, places_of
from sbi_active.mujoco.models.quantities import field_of
from sbi_active.mujoco.models.spec import mujoco


@dataclass
class Run:
    """Rows that one model simulates at once.

    Attributes:
        model: Model of all rows.
        models: Copies of it, one a row.
        rows: Rows.
        state: Physics states at the start, shape (n, nstate).
        controls: Controls and poses of mocap bodies, shape
            (n, steps, nu + 7 nmocap), held over each step.
    """

    model: Model
    models: list[Any]
    rows: Rows
    state: Array
    controls: Array

    @classmethod
    def of(
        cls, model: Model, models: list[Any], rows: Rows, grid: Array | None, steps: int
    ) -> Run:
        """Return rows at their start.

        Args:
            model: Model of all rows.
            models: Copies of it, one a row.
            rows: Rows.
            grid: Times of the inputs, shape (m,).
            steps: Number of readings.
        """
        base, size = model.base, physics_size(model.base)
        first, places = initial(base, model.data), places_of(base)
        every = np.repeat(first[None], len(rows), 0)
        for name, value in rows.start.items():
            every[:, places[name]] = value
        controls = np.repeat(every[:, None, size:], steps, 1)
        for name, series in rows.inputs.items():
            place = element_id(base, "actuator", name)
            assert grid is not None
            controls[:, :, place] = held(series, grid, steps, base.opt.timestep)
        return cls(model, models, rows, every[:, :size], controls)

    def begin(self, i: int, data: Any) -> None:
        """Set data to the start of a row."""
        mujoco.mj_resetData(self.models[i], data)
        for state, kind in zip(
            (self.state[i], self.controls[i, 0]), kinds(), strict=True
        ):
            mujoco.mj_setState(self.models[i], data, state, kind)

    def readings(self) -> Array:
        """Return the sensors' readings, shape (n, steps, sensordata).

        They are NaN throughout for a row that diverged.
        """
        if self.model.inserted:
            self._settle()
        x, finished = _stepped(self) if self.rows.is_stepped else _rolled(self)
        x[~finished] = np.nan
        return x

    def _settle(self) -> None:
        """Move inserted elements to where they rest."""
        data = self.model.data
        for i, own in enumerate(self.models):
            self.begin(i, data)
            mujoco.mj_forward(own, data)
            for change in self.model.inserted:
                change.settle(own, data, self.rows.changes[change][i])
            mujoco.mj_getState(own, data, self.state[i], kinds()[0])


def kinds() -> tuple[int, int]:
    """Return MuJoCo's kinds of state of a row's physics, and of what is held."""
    state = mujoco.mjtState
    held = state.mjSTATE_CTRL, state.mjSTATE_MOCAP_POS, state.mjSTATE_MOCAP_QUAT
    return state.mjSTATE_FULLPHYSICS.value, sum(kind.value for kind in held)


def initial(model: Any, data: Any, key: int | None = None) -> Array:
    """Return physics state and what is held of a model, or of one of its keyframes.

    Args:
        model: Compiled model.
        data: Data of the model, to work in.
        key: Number of the keyframe.
    """
    mujoco.mj_resetData(model, data)
    if key is not None:
        mujoco.mj_resetDataKeyframe(model, data, key)
    parts = []
    for kind in kinds():
        parts.append(np.empty(mujoco.mj_stateSize(model, kind)))
        mujoco.mj_getState(model, data, parts[-1], kind)
    return np.concatenate(parts)


def _rolled(run: Run) -> tuple[Array, Array]:
    """Return readings by MuJoCo's rollout, and which rows came to their end."""
    steps = run.controls.shape[1]
    state, sensors = mujoco.rollout.rollout(
        run.models,
        mujoco.MjData(run.model.base),
        run.state,
        run.controls,
        control_spec=kinds()[1],
        nstep=steps,
    )
    # A rollout ends where MuJoCo warns, and repeats its last state from there on.
    span = steps * np.array([m.opt.timestep for m in run.models])
    ran = np.abs(state[:, -1, 0] - run.state[:, 0] - span) < 0.5 * span / steps
    return sensors, ran & np.isfinite(sensors).all((1, 2))


def _stepped(run: Run) -> tuple[Array, Array]:
    """Return readings step by step, and which rows came to their end."""
    model, models, rows = run.model, run.models, run.rows
    steps, step = run.controls.shape[1], model.base.opt.timestep
    while len(model.datas) < len(models):
        model.datas.append(mujoco.MjData(model.base))
    datas = model.datas[: len(models)]
    for i, data in enumerate(datas):
        run.begin(i, data)
    x = np.empty((len(rows), steps, model.base.nsensordata))
    # Views: what MuJoCo writes is there at the next look.
    q, v = [d.qpos for d in datas], [d.qvel for d in datas]
    applied, sensors = [d.qfrc_applied for d in datas], [d.sensordata for d in datas]
    controls = [d.ctrl for d in datas]
    going = np.ones(len(rows), dtype=bool)
    pairs = [*zip(models, datas, strict=True)]
    following = _Following(run, datas)
    given = [*run.controls[..., : model.base.nu]]
    with np.errstate(all="ignore"):  # of rows that diverge
        for k in range(steps):
            if rows.forces:
                now = np.stack(q)[:, model.positions]
                speed = np.stack(v)[:, model.velocities]
                total = np.zeros((len(rows), model.base.nv))
                for force, phi in rows.forces.items():
                    total[:, model.velocities] += force(now, speed, k * step, phi)
                for one, value in zip(applied, total, strict=True):
                    one[:] = value
            tables = following.tables(q, v)
            for i in np.flatnonzero(going).tolist():
                controls[i][:] = given[i][k]
                for fields, dofs, table in tables:
                    for dof in dofs:
                        fields[i][dof] = table[i][dof]
                mujoco.mj_step(*pairs[i])
                x[i, k] = sensors[i]
            if k % 64 == 0 or k == steps - 1:
                bad = [d.warning.number.any() for d in datas]
                going &= ~np.array(bad)
    following.restore()
    return x, going & np.isfinite(x).all((1, 2))


class _Following:
    """Fields of each row's model that follow the state of its joints."""

    def __init__(self, run: Run, datas: list[Any]) -> None:
        self.loads = [data.qfrc_actuator for data in datas]
        self.changes, base = [], run.model.base
        for change, phi in run.rows.changes.items():
            if isinstance(change, StateChange):
                joints = [element_id(base, "joint", name) for name in change.joints()]
                places = base.jnt_qposadr[joints], base.jnt_dofadr[joints]
                self.changes.append((change.fields()[0], change, phi, *places))
        # Rows of the same numbers share a model: what it has is looked up before any of
        # them runs.
        names = dict.fromkeys(name for name, *_ in self.changes)
        self.fields = {n: [field_of(own, n) for own in run.models] for n in names}
        self.before = {name: np.array(fields) for name, fields in self.fields.items()}
        own = {n: [part[-1] for part in self.changes if part[0] == n] for n in names}
        self.entries = {n: np.unique(np.concatenate(own[n])).tolist() for n in names}

    def tables(self, q: list[Array], v: list[Array]) -> list[tuple[Any, Any, Any]]:
        """Return fields by row, entries that change, and each row's numbers.

        Args:
            q: Positions of each row.
            v: Velocities.
        """
        if not self.changes:
            return []
        at, speed, load = np.stack(q), np.stack(v), np.stack(self.loads)
        total = {name: before.copy() for name, before in self.before.items()}
        for name, change, phi, places, dofs in self.changes:  # they add up
            state = at[:, places], speed[:, dofs], load[:, dofs]
            total[name][:, dofs] += change.values(
                *state, phi
            )  # those of a field add up
        return [
            (fields, self.entries[name], total[name].tolist())
            for name, fields in self.fields.items()
        ]

    def restore(self) -> None:
        """Write back what the models had."""
        for name, fields in self.fields.items():
            for own, values in zip(fields, self.before[name], strict=True):
                own[:] = values


#: Share of a step by which a time may be off and count as that of a step.
ON_TIME = 1e-3


def num_steps(times: Array, start: float, step: float) -> int:
    """Return the number of readings, one a step from the start, up to the last time."""
    last = float(times.max()) - start
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
    last, wanted = readings.shape[1] - 1, times[..., None]
    if late is not None:
        wanted = wanted - late[:, None]
    place = np.clip((wanted - start) / step, 0, last)
    nearest = np.round(place)
    place = np.where(np.abs(place - nearest) < ON_TIME, nearest, place)
    low = np.floor(place).astype(int)
    found, weight = np.take_along_axis(readings, low, 1), place - low
    if not weight.any():
        return found
    after = np.take_along_axis(readings, np.minimum(low + 1, last), 1)
    return np.where(weight > 0, (1 - weight) * found + weight * after, found)

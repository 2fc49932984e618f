"""Rows of a machine, stepped: what its sensors read at every step.

Without forces of a caller, or changes that follow the state, MuJoCo's own rollout runs
each row to its end. With them all rows go step by step together, so that a force is
computed once a step for all.

A sensor's reading belongs to the state before a step: reading k is at time k h.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from sbi_active.arrays import Array
from sbi_active.mujoco.models.changes import StateChange
from sbi_active.mujoco.models.machine import Model, Rows
from sbi_active.mujoco.models.names import element_id, start_places
from sbi_active.mujoco.models.quantities import field_of
from sbi_active.mujoco.models.spec import mujoco_of


def readings(model: Model, models: list[Any], rows: Rows, *, threads: int = 1) -> Array:
    """Return the sensors' readings, NaN throughout for a row that diverged.

    Args:
        model: Model of all rows.
        models: Models, one a row.
        rows: Rows whose controls have shape (n, steps, nu + 7 nmocap).
        threads: Threads of MuJoCo's rollout.

    Returns:
        Shape (n, steps, sensordata).
    """
    start = start_states(model, rows)
    _settle(model, models, rows, start)
    run = _stepped if rows.is_stepped else _rolled_out
    x, finished = run(model, models, start, rows, threads)
    x[~finished] = np.nan
    return x


def start_states(model: Model, rows: Rows) -> Array:
    """Return the physics states that rows start from, shape (n, nstate)."""
    mujoco = mujoco_of()
    kind = mujoco.mjtState.mjSTATE_FULLPHYSICS.value
    base, data = model.base, model.data
    mujoco.mj_resetData(base, data)
    state = np.empty(mujoco.mj_stateSize(base, kind))
    mujoco.mj_getState(base, data, state, kind)
    states = np.repeat(state[None], len(rows), 0)
    places = start_places(base)
    for name, value in rows.start.items():
        if name in places:  # and not held, as a control is
            states[:, 1 + places[name]] = value  # the time comes first
    return states


def begin(model: Any, data: Any, state: Array, held: Array) -> None:
    """Set the start of a row.

    Args:
        model: Model of the row.
        data: Data of the model, to set.
        state: Physics state, shape (nstate,).
        held: Controls and poses of mocap bodies, shape (nu + 7 nmocap,).
    """
    mujoco = mujoco_of()
    mujoco.mj_resetData(model, data)
    mujoco.mj_setState(model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS.value)
    mujoco.mj_setState(model, data, held, held_kind())


def held_kind() -> int:
    """Return the kind of MuJoCo's state that a row's controls are."""
    state = mujoco_of().mjtState
    kinds = state.mjSTATE_CTRL, state.mjSTATE_MOCAP_POS, state.mjSTATE_MOCAP_QUAT
    return sum(kind.value for kind in kinds)


def held_states(model: Model) -> Array:
    """Return the states held where nothing says otherwise, shape (nu + 7 nmocap,)."""
    mujoco = mujoco_of()
    mujoco.mj_resetData(model.base, model.data)
    held = np.empty(mujoco.mj_stateSize(model.base, held_kind()))
    mujoco.mj_getState(model.base, model.data, held, held_kind())
    return held


def _settle(model: Model, models: list[Any], rows: Rows, start: Array) -> None:
    """Move inserted elements to where they rest, in place."""
    if not model.inserted:
        return
    mujoco = mujoco_of()
    kind = mujoco.mjtState.mjSTATE_FULLPHYSICS.value
    for i, own in enumerate(models):
        begin(own, model.data, start[i], rows.controls[i, 0])
        mujoco.mj_forward(own, model.data)
        for change in model.inserted:
            change.settle(own, model.data, rows.changes[change][i])
        mujoco.mj_getState(own, model.data, start[i], kind)


def _rolled_out(
    model: Model, models: list[Any], start: Array, rows: Rows, threads: int
) -> tuple[Array, Array]:
    mujoco = mujoco_of()
    steps = rows.controls.shape[1]
    data = [mujoco.MjData(model.base) for _ in range(threads)]
    state, sensors = mujoco.rollout.rollout(
        *(models, data, start, rows.controls),
        control_spec=held_kind(),
        nstep=steps,
        persistent_pool=threads > 1,
    )
    # A rollout ends where MuJoCo warns, and repeats its last state from there on.
    span = steps * np.array([m.opt.timestep for m in models])
    ran = np.abs(state[:, -1, 0] - start[:, 0] - span) < 0.5 * span / steps
    return sensors, ran & np.isfinite(sensors).all((1, 2))


def _stepped(
    model: Model, models: list[Any], start: Array, rows: Rows, threads: int
) -> tuple[Array, Array]:
    mujoco = mujoco_of()
    steps, step = rows.controls.shape[1], model.base.opt.timestep
    while len(model.datas) < len(models):
        model.datas.append(mujoco.MjData(model.base))
    datas = model.datas[: len(models)]
    for i, (own, data) in enumerate(zip(models, datas, strict=True)):
        begin(own, data, start[i], rows.controls[i, 0])
    x = np.empty((len(rows), steps, model.base.nsensordata))
    # Views: what MuJoCo writes is there at the next look.
    q, v = [d.qpos for d in datas], [d.qvel for d in datas]
    applied, sensors = [d.qfrc_applied for d in datas], [d.sensordata for d in datas]
    controls = [d.ctrl for d in datas]
    going = np.ones(len(rows), dtype=bool)
    pairs = [*zip(models, datas, strict=True)]
    following = _Following(model, models, datas, rows)
    given = [*rows.controls[..., : model.base.nu]]
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
                    for dof, number in zip(dofs, table[i], strict=True):
                        fields[i][dof] = number
                mujoco.mj_step(*pairs[i])
                x[i, k] = sensors[i]
            if k % 64 == 0 or k == steps - 1:
                bad = [d.warning.number.any() for d in datas]
                going &= ~np.array(bad)
    following.restore()
    return x, going & np.isfinite(x).all((1, 2))


class _Following:
    """Entries of each row's model that follow the state of its joints."""

    def __init__(
        self, model: Model, models: list[Any], datas: list[Any], rows: Rows
    ) -> None:
        self.loads = [d.qfrc_actuator for d in datas]
        own, base = [], model.base
        for change, phi in rows.changes.items():
            if isinstance(change, StateChange):
                joints = [element_id(base, "joint", name) for name in change.joints()]
                places = base.jnt_qposadr[joints], base.jnt_dofadr[joints]
                own.append((change, phi, *places))
        # Changes of one field add up. Rows of the same numbers share a model: what it
        # has is looked up before any of them runs.
        self.parts = []
        for name in dict.fromkeys(one[0].fields()[0] for one in own):
            some = [one for one in own if one[0].fields()[0] == name]
            dofs = np.unique(np.concatenate([one[3] for one in some]))
            some = [(*one, np.searchsorted(dofs, one[3])) for one in some]
            fields = [field_of(each, name) for each in models]
            before = np.array([field[dofs] for field in fields])
            self.parts.append((fields, dofs.tolist(), before, some))

    def tables(self, q: list[Array], v: list[Array]) -> list[tuple[Any, Any, Any]]:
        """Return fields by row, entries, and the numbers that each row has there.

        Args:
            q: Positions of each row.
            v: Velocities.
        """
        if not self.parts:
            return []
        at, speed, load = np.stack(q), np.stack(v), np.stack(self.loads)
        found = []
        for fields, dofs, before, changes in self.parts:
            total = before.copy()
            for change, phi, places, own, among in changes:
                state = at[:, places], speed[:, own], load[:, own]
                total[:, among] += change.values(*state, phi)
            found.append((fields, dofs, total.tolist()))
        return found

    def restore(self) -> None:
        """Write back what the models had."""
        for fields, dofs, before, _ in self.parts:
            for field, values in zip(fields, before, strict=True):
                field[dofs] = values

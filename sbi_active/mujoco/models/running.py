"""Rows of a machine, stepped: what its sensors read at every step.

Without forces of a caller, or changes that follow the state, MuJoCo's own rollout runs
each row to its end. With them all rows go step by step together, so that a force is
computed once a step for all.

A sensor's reading belongs to the state before a step: reading k is at time k h.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sbi_active.mujoco.models.changes import StateChange
from sbi_active.mujoco.models.fields import field_of
from sbi_active.mujoco.models.machine import Model, Rows
from sbi_active.mujoco.models.names import element_id, start_places
from sbi_active.mujoco.models.spec import mujoco_of

__all__ = ["readings", "start_states"]

Array = NDArray[Any]


def readings(model: Model, models: list[Any], rows: Rows, *, threads: int = 1) -> Array:
    """Return what the sensors read, NaN throughout for a row that diverged.

    Args:
        model: Of all rows.
        models: One a row.
        rows: Of controls of shape (n, steps, nu).
        threads: Of MuJoCo's rollout.

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
        states[:, 1 + places[name]] = value  # the time comes first
    return states


def _settle(model: Model, models: list[Any], rows: Rows, start: Array) -> None:
    """Move inserted elements to where they rest, in place."""
    if not model.inserted:
        return
    mujoco = mujoco_of()
    kind = mujoco.mjtState.mjSTATE_FULLPHYSICS.value
    for i, own in enumerate(models):
        mujoco.mj_resetData(own, model.data)
        mujoco.mj_setState(own, model.data, start[i], kind)
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
        models, data, start, rows.controls, nstep=steps, persistent_pool=threads > 1
    )
    # A rollout ends where MuJoCo warns, and repeats its last state from there on.
    span = steps * np.array([m.opt.timestep for m in models])
    ran = np.abs(state[:, -1, 0] - start[:, 0] - span) < 0.5 * span / steps
    return sensors, ran & np.isfinite(sensors).all((1, 2))


def _stepped(
    model: Model, models: list[Any], start: Array, rows: Rows, threads: int
) -> tuple[Array, Array]:
    mujoco = mujoco_of()
    kind = mujoco.mjtState.mjSTATE_FULLPHYSICS.value
    steps, step = rows.controls.shape[1], model.base.opt.timestep
    while len(model.datas) < len(models):
        model.datas.append(mujoco.MjData(model.base))
    datas = model.datas[: len(models)]
    for own, data, state in zip(models, datas, start, strict=True):
        mujoco.mj_resetData(own, data)
        mujoco.mj_setState(own, data, state, kind)
    x = np.empty((len(rows), steps, model.base.nsensordata))
    # Views: what MuJoCo writes is there at the next look.
    q, v = [d.qpos for d in datas], [d.qvel for d in datas]
    applied, sensors = [d.qfrc_applied for d in datas], [d.sensordata for d in datas]
    controls = [d.ctrl for d in datas]
    going = np.ones(len(rows), dtype=bool)
    pairs = [*zip(models, datas, strict=True)]
    following = _Following(model, models, datas, rows)
    with np.errstate(all="ignore"):  # of rows that diverge
        for k in range(steps):
            now = np.stack(q)[:, model.positions]
            speed = np.stack(v)[:, model.velocities]
            total = np.zeros((len(rows), model.base.nv))
            for force, phi in rows.forces.items():
                total[:, model.velocities] += force(now, speed, k * step, phi)
            changed = following.changed(q, v)
            for i in np.flatnonzero(going).tolist():
                controls[i][:] = rows.controls[i, k]
                applied[i][:] = total[i]
                for field, places, numbers in changed[i]:
                    for place, number in zip(places, numbers, strict=True):
                        field[place] = number
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
        base, changes = model.base, [*rows.changes.items()]
        self.parts = []
        for change, phi in changes:
            if not isinstance(change, StateChange):
                continue
            joints = [element_id(base, "joint", name) for name in change.joints()]
            at, dofs = base.jnt_qposadr[joints], base.jnt_dofadr[joints]
            self.parts.append((change, phi, at, dofs))
        # Changes of one field add up. Rows of the same numbers share a model: what it
        # has is looked up before any of them runs.
        self.fields = {}
        for name in dict.fromkeys(part[0].fields()[0] for part in self.parts):
            own = [p[3] for p in self.parts if p[0].fields()[0] == name]
            dofs = np.unique(np.concatenate(own))
            fields = [field_of(each, name) for each in models]
            self.fields[name] = fields, dofs, np.array([f[dofs] for f in fields])

    def changed(self, q: list[Array], v: list[Array]) -> list[list[Any]]:
        """Return fields, places and numbers that are to be written, by row."""
        found: list[list[Any]] = [[] for _ in self.loads]
        if not self.parts:
            return found
        at, speed, load = np.stack(q), np.stack(v), np.stack(self.loads)
        for name, (fields, dofs, before) in self.fields.items():
            total = before.copy()
            for change, phi, places, own in self.parts:
                if change.fields()[0] == name:
                    state = at[:, places], speed[:, own], load[:, own]
                    total[:, np.searchsorted(dofs, own)] += change.values(*state, phi)
            for i, numbers in enumerate(total.tolist()):
                found[i].append((fields[i], dofs.tolist(), numbers))
        return found

    def restore(self) -> None:
        """Write back what the models had."""
        for fields, dofs, before in self.fields.values():
            for field, values in zip(fields, before, strict=True):
                field[dofs] = values

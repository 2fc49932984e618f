"""Models that are compiled once a process, and run for many parameters."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import compress, product
from typing import Any

import numpy as np

from sbi_active.arrays import Array
from sbi_active.mujoco.models.changes import Insertion, ModelChange, StateChange
from sbi_active.mujoco.models.names import start_places
from sbi_active.mujoco.models.parameters import Bounded, Writer, renew, writer_of
from sbi_active.mujoco.models.quantities import field_of, set_field
from sbi_active.mujoco.models.spec import Source, mujoco

#: Rows and models at a time: more gain nothing, and each has memory of its own.
POOL = 32


@dataclass
class Rows:
    """Rows to simulate.

    Attributes:
        theta: Parameters, shape (n, d).
        changes: Parameters by change, shape (n, k).
        forces: Parameters by force, shape (n, k).
        start: What is set at the start, by name, shape (n,).
        inputs: Controls over time by actuator, shape (n, m).
        times: Times of the readings, shape (n, k).
    """

    theta: Array
    changes: dict[Any, Array]
    forces: dict[Any, Array]
    start: dict[str, Array]
    inputs: dict[str, Array]
    times: Array

    def __len__(self) -> int:
        return len(self.theta)

    @property
    def is_stepped(self) -> bool:
        """Whether something must be computed between the steps."""
        return bool(self.forces) or any(
            isinstance(change, StateChange) for change in self.changes
        )

    def at(self, rows: Any) -> Rows:
        """Return some rows."""
        each = self.changes, self.forces, self.start, self.inputs
        changes, forces, start, inputs = (
            {key: value[rows] for key, value in part.items()} for part in each
        )
        return Rows(self.theta[rows], changes, forces, start, inputs, self.times[rows])


@dataclass
class Model:
    """A compiled model, copies of it, and what writes parameters.

    Attributes:
        base: Compiled model; nothing is written into it.
        writer: Writer of the parameters.
        data: Data to work in.
        positions: Places of the machine's ``qpos`` in that of this model.
        velocities: Places of the machine's ``qvel`` in that of this model.
        inserted: Insertions that the machine's model does not have.
        pool: Copies of the base that are written into.
        datas: Data to step rows together.
        originals: Fields as compiled, of those that are ever written.
    """

    base: Any
    writer: Writer
    data: Any
    positions: Array
    velocities: Array
    inserted: tuple[Insertion, ...] = ()
    pool: list[Any] = field(default_factory=list)
    datas: list[Any] = field(default_factory=list)
    originals: dict[str, Any] = field(default_factory=dict)

    def each(self, rows: Rows) -> list[Any]:
        """Return a model for every row; rows of the same numbers share one."""
        changes = [
            change
            for change in rows.changes
            if not isinstance(change, Insertion) or change in self.inserted
        ]
        table = np.concatenate([rows.theta, *(rows.changes[c] for c in changes)], 1)
        _, first, number = np.unique(
            table, axis=0, return_index=True, return_inverse=True
        )
        models = [
            self.written(k, rows.theta[i], {c: rows.changes[c][i] for c in changes})
            for k, i in enumerate(first)
        ]
        return [models[k] for k in number.reshape(-1)]

    def written(
        self, number: int, theta: Array, changes: Mapping[ModelChange, Array]
    ) -> Any:
        """Return a model with its parameters and changes.

        Args:
            number: Number of the copy to write into.
            theta: Parameters, shape (d,).
            changes: Parameters by change, shape (k,).
        """
        if self.writer.compiled is not None:
            model = self.writer.compiled(theta)
        else:
            names = {*self.writer.parts}.union(*(c.fields() for c in changes))
            for name in names - {*self.originals}:
                self.originals[name] = np.array(field_of(self.base, name))
            while len(self.pool) <= number:
                self.pool.append(copy.copy(self.base))
            model = self.pool[number]
            for name, value in self.originals.items():
                set_field(model, name, value)
            self.writer.write(model, theta)
        for change, phi in changes.items():
            change.write(model, phi)
        renew(model, self.data)
        return model


class Machine:
    """A model with parameters.

    Args:
        source: Source of the model.
        parameters: Parameters in the order of theta.
        edit: ``edit(spec, theta)`` of all of them at once, in place of theirs.

    Attributes:
        model: Compiled model.
    """

    def __init__(
        self,
        source: Source,
        parameters: Sequence[Bounded],
        *,
        edit: Callable[[Any, Array], Any] | None = None,
    ) -> None:
        self.source, self.parameters, self.edit = source, tuple(parameters), edit
        self.model = _lasting(source.compile())
        # Found here, with all digits of the spec, and used in every process.
        writer = writer_of(
            source.exact, self.model, self.parameters, edit=edit, text=source.spec
        )
        self._writer = writer if writer.compiled is None else None
        self._models: dict[tuple[Insertion, ...], Model] = {}

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_models": {}}

    def batches(
        self, rows: Rows, size: int
    ) -> Iterator[tuple[Model, list[Any], Array, Array]]:
        """Yield rows, whatever models they need, a few at a time.

        Args:
            rows: Rows, all of them. One that is a mixture comes several times.
            size: Most rows at a time.

        Yields:
            The model, and for each row its copy, its place among all rows, and the
            share of its readings in what is read.
        """
        for inserted, places, weights in self._groups(rows):
            model = self._model(inserted)
            for first in range(0, len(places), min(size, POOL)):
                part = slice(first, first + min(size, POOL))
                models = model.each(rows.at(places[part]))
                yield model, models, places[part], weights[part]

    def _groups(self, rows: Rows) -> list[tuple[tuple[Insertion, ...], Array, Array]]:
        """Return the insertions, their rows, and their weights in the readings."""
        insertions = [c for c in rows.changes if isinstance(c, Insertion)]
        each = [list(map(c.share, rows.changes[c])) for c in insertions]
        shares = np.array(each).reshape(len(insertions), len(rows))
        groups = []
        for pattern in product((False, True), repeat=len(insertions)):
            on = np.array(pattern, dtype=bool)[:, None]
            weights = np.where(on, shares, 1 - shares).prod(0)
            places = np.flatnonzero(weights)
            if len(places):
                inserted = tuple(compress(insertions, pattern))
                groups.append((inserted, places, weights[places]))
        return groups

    def _model(self, inserted: tuple[Insertion, ...]) -> Model:
        if inserted not in self._models:
            spec = self.source.edited(*(change.edit for change in inserted)).spec
            base, writer = self.model, self._writer
            if inserted:
                base, writer = _lasting(spec().compile()), None
            self._models[inserted] = Model(
                base,
                writer or writer_of(spec, base, self.parameters, edit=self.edit),
                mujoco.MjData(base),
                *self._order(base),
                inserted,
            )
        return self._models[inserted]

    def _order(self, base: Any) -> tuple[Array, Array]:
        """Return the places of the machine's positions and velocities in a model."""
        own, other = start_places(self.model), start_places(base)
        order = sorted(own, key=own.__getitem__)
        places = np.array([other[name] - 1 for name in order], dtype=int)
        nq, nv = self.model.nq, self.model.nv
        return places[:nq], places[nq : nq + nv] - base.nq


def _lasting(model: Any) -> Any:
    """Return a model in which a state that diverges stays, and starts not again."""
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    return model

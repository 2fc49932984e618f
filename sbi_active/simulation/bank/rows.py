"""The rows of a bank: written in segments, found again, and read by position."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import NoneType
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.arrays import own_tensor
from sbi_active.messages import warn
from sbi_active.simulation.bank.sqlite import require, sensible
from sbi_active.simulation.bank.store import Store
from sbi_active.support import log_density

#: Bytes of a segment: what reading one row may cost in memory. With 16 MiB, ten rows of
#: 1 MB one by one take four times the CPU, and nothing else takes less.
SEGMENT_BYTES = 4 * 2**20
COLUMNS = ("theta", "action", "x", "status", "index", "log_proposal")
#: Entries of a header, and what they may be.
HEADER: dict[str, tuple[type, ...]] = {
    "created": (str, NoneType),
    "version": (str,),
    "simulator": (dict, str),
    "parameter_names": (list, NoneType),
    "shapes": (dict, NoneType),
}
KNOWN = {"run": str, "seed": int, "label": str}  # of all rows of a segment


@dataclass(frozen=True)
class Segment:
    """Rows of one run that were written at once.

    Attributes:
        number: Place of the segment among those of the bank, from 1.
        rows: All of the rows but x, which stays on the disk.
        run: Name of the run that the rows belong to.
        seed: Seed of the run.
        label: Label of the run's proposal; "" if it is not known.
    """

    number: int
    rows: np.ndarray
    run: str
    seed: int
    label: str


class Rows:
    """The segments of one bank in a store.

    Args:
        store: File with the segments.
        name: Name of the bank.

    Attributes:
        store: File with the segments.
        key: Kind of the record of the bank's header.
    """

    def __init__(self, store: Store, name: str) -> None:
        self.store, self._name, self.key = store, name, f"bank {name}"
        self._generation = -1
        self._forget()

    @property
    def header(self) -> dict[str, Any]:
        """Simulator, shapes and names, as they are on the disk."""
        found, path = self.store.json(self.key), self.store.path
        if found is None:
            kinds = [kind for kind in self.store.catalog if kind.startswith("bank ")]
            raise ValueError(
                f"expected the {self.key} in {path}; got {', '.join(kinds) or 'none'}; "
                "give name= of one there, or simulator= to make one"
            )
        with sensible(path):
            own = all(isinstance(found[name], kinds) for name, kinds in HEADER.items())
            names = found["parameter_names"] or []
            own &= all(isinstance(name, str) for name in names)
            require(path, own, "a header that none writes")
            _ = found["shapes"] is None or row_type(found["shapes"])
        return found

    def segments(self) -> list[Segment]:
        """Return the segments as they are on the disk now."""
        with self.store.reading():
            total = self.store.length(self._name)
            if self._generation != self.store.generation or total < len(self._found):
                self._forget()
                self._generation = self.store.generation
            if total > len(self._found):
                with sensible(self.store.path):
                    shapes = self.header["shapes"]
                    kind, self._x_shape = row_type(shapes), shapes["x"]
                    for number in range(len(self._found) + 1, total + 1):
                        segment = self._segment(number, kind)
                        self._found.append(segment)
                        self._of_run[segment.run].append(segment)
            return self._found[:]

    def of_run(self, run: str) -> Sequence[Segment]:
        """Return the segments of a run as they are on the disk now."""
        self.segments()
        return self._of_run.get(run, ())

    def _forget(self) -> None:
        self._found: list[Segment] = []
        self._of_run: defaultdict[str, list[Segment]] = defaultdict(list)
        self._x_shape: Sequence[int] = ()
        self._last = 0, np.zeros(0)  # the segment whose x was read last

    def _segment(self, number: int, kind: np.dtype) -> Segment:
        head = self.store.get(self._name, number) or b""
        text, _, content = head.partition(b"\n")
        known = json.loads(text)
        rows = np.frombuffer(content, kind)
        own = {name: type(value) for name, value in known.items()} == KNOWN
        own &= bool((rows["index"] >= 0).all())
        own &= bool((np.abs(rows["status"] - 1) <= 1).all())  # those of an outcome
        require(self.store.path, own, f"a segment {number} that no bank writes")
        return Segment(number, rows, **known)

    def x(self, segment: Segment) -> np.ndarray:
        """Return what the rows of a segment measured; it cannot be written to."""
        if self._last[0] != segment.number:
            content = self.store.body(self._name, segment.number)
            with sensible(self.store.path):
                shape = len(segment.rows), *self._x_shape
                x = np.frombuffer(content, "<f4").reshape(shape)
            self._last = segment.number, x
        return self._last[1]

    def append(self, run: Mapping[str, Any], columns: Mapping[str, Tensor]) -> None:
        """Write those rows of a run that are not there, on the disk at the end.

        Raises:
            ValueError: If the rows have other shapes than those in the bank.
        """
        arrays = {name: c.detach().cpu().numpy() for name, c in columns.items()}
        shapes = {name: [*arrays[name].shape[1:]] for name in COLUMNS[:3]}
        header, x, index = self.header, arrays.pop("x"), arrays["index"]
        known = header["shapes"]
        if known not in (None, shapes) and self.segments():
            raise ValueError(
                f"expected rows of shapes {known}, as in the bank {self.store.folder}; "
                f"got {shapes}; make a bank of its own for them"
            )
        before = [segment.rows["index"] for segment in self.of_run(run["run"])]
        largest = max(int(part.max(initial=-1)) for part in (*before, index))
        is_stored = np.zeros(largest + 1, bool)
        for part in before:
            is_stored[part] = True
        first = np.unique(index, return_index=True)[1]  # of those that are given twice
        fresh = np.sort(first[~is_stored[index[first]]])
        rows = np.empty(len(index), row_type(shapes))
        for name, array in arrays.items():
            rows[name] = array
        size = max(1, SEGMENT_BYTES // max(rows.itemsize + x[:1].nbytes, 1))
        with self.store.writing():
            if known != shapes:
                self.store.put(self.key, 0, {**header, "shapes": shapes})
            for start in range(0, len(fresh), size):
                part = fresh[start : start + size]
                head = json.dumps(run).encode() + b"\n" + rows[part].tobytes()
                body = np.ascontiguousarray(x[part], "<f4").reshape(-1).view(np.uint8)
                self.store.append(self._name, head, body.data)

    def gather(self, names: Sequence[str], rows: np.ndarray) -> list[Tensor]:
        """Return columns at positions."""
        segments = self.segments()
        if not segments:
            raise ValueError(
                f"expected rows in {self.store.folder}; got none; simulate into it"
            )
        starts = np.cumsum([0, *(len(segment.rows) for segment in segments[:-1])])
        which = np.searchsorted(starts, rows, side="right") - 1
        order = np.argsort(which, kind="stable")
        groups = np.split(order, np.flatnonzero(np.diff(which[order])) + 1)
        labels = [*dict.fromkeys(segment.label for segment in segments)]
        of_run = {
            "seed": [segment.seed for segment in segments],
            "label": [labels.index(segment.label) for segment in segments],
        }
        columns = []
        for name in names:
            if name in of_run:
                column = _whole_numbers(of_run[name])[which]
            else:
                of_x = np.dtype(("<f4", (*self._x_shape,)))
                of_row = of_x if name == "x" else segments[0].rows.dtype[name]
                column = np.empty(len(rows), of_row)
                for group in groups if len(rows) else ():
                    k = which[group[0]]
                    is_x = name == "x"
                    values = self.x(segments[k]) if is_x else segments[k].rows[name]
                    column[group] = values[rows[group] - starts[k]]
            columns.append(torch.from_numpy(column))
        return columns


def row_type(shapes: Mapping[str, Sequence[int]]) -> np.dtype:
    """Return the type of a row but for x, whose shape is looked at as well."""
    theta, action, _ = (np.empty((0, *shapes[n])).shape[1:] for n in COLUMNS[:3])
    tables = ("theta", "<f4", theta), ("action", "<f4", action)
    own = ("log_proposal", "<f8"), ("index", "<i8"), *tables, ("status", "i1")
    return np.dtype([*own])


def columns_of(
    rows: Mapping[str, Any], proposal: Distribution | None, label: str
) -> dict[str, Tensor]:
    """Return the columns of rows that are to be written.

    Args:
        rows: The rows.
        proposal: Proposal that theta was drawn from; None if it is not known.
        label: Label of the proposal.

    Raises:
        ValueError: If they differ in length, or are no numbers that float32 holds.
    """
    index = rows["index"]
    columns: dict[str, Tensor] = {
        **{n: own_tensor(rows[n], torch.float32, name=n) for n in COLUMNS[:3]},
        **{"status": rows["status"], "index": index},
    }
    lengths = {name: len(column) for name, column in columns.items()}
    if len({*lengths.values()}) > 1:
        raise ValueError(
            f"expected {len(index)} rows, one an index; got {lengths}; give columns of "
            "one length"
        )
    log_proposal = torch.full((len(index),), torch.nan, dtype=torch.float64)
    if proposal is not None:
        log_proposal = log_density(proposal, rows["theta"])
        num_outside = int((log_proposal == -torch.inf).sum())
        if num_outside:
            warn(
                f"SA305 {num_outside} of {len(index)} rows have density 0 under the "
                f"proposal {label!r}: they were not drawn from it",
                stacklevel=3,
            )
    return {**columns, "log_proposal": log_proposal}


def positions(rows: Any, total: int) -> np.ndarray:
    """Return the positions of rows, int64.

    Args:
        rows: Positions, a slice, a mask over all rows, or None for all.
        total: Number of all rows.

    Raises:
        ValueError: If they are anything else.
    """
    if rows is None or isinstance(rows, slice):
        return np.arange(*(rows or slice(None)).indices(total))
    found = np.asarray(rows)
    if found.dtype == bool and found.shape == (total,):
        return np.flatnonzero(found)
    whole = found.ndim == 1 and found.dtype.kind in "iu"
    if not whole or not bool(((found >= 0) & (found < total)).all()):
        raise ValueError(
            f"expected positions of rows within [0, {total}), or a mask of "
            f"{total}; got {rows!r}; use what columns() is indexed by"
        )
    return found


def _whole_numbers(values: Sequence[int]) -> np.ndarray:
    try:
        return np.array(values, np.int64)
    except OverflowError as error:
        raise ValueError(
            "expected seeds below 2**63 for a column of them; got one of "
            f"{max(values, key=abs).bit_length()} bits; read the other columns"
        ) from error

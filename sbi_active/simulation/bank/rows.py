"""The rows of a bank: segments in a store, found again and read by position."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
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
from sbi_active.simulation.outcomes import Outcome, Simulations
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
    """The rows of one bank in a store, to be read.

    Args:
        store: File with the rows.
        name: Name of the bank in it.
    """

    def __init__(self, store: Store, name: str) -> None:
        self._store, self.path = store, store.folder
        self._name, self._key = name, f"bank {name}"
        self._found: list[Segment] = []
        self._generation = -1
        self._last = 0, np.zeros(0)  # the segment whose x was read last

    @property
    def header(self) -> dict[str, Any]:
        """Simulator, shapes and names, as they are on the disk."""
        found, path = self._store.json(self._key), self._store.path
        if found is None:
            kinds = ", ".join(k for k in self._store.catalog if k.startswith("bank "))
            raise ValueError(
                f"expected the {self._key} in {path}; got {kinds or 'none'}; give "
                "name= of one there, or simulator= to make one"
            )
        with sensible(path):
            own = all(isinstance(found[name], kinds) for name, kinds in HEADER.items())
            own &= all(isinstance(n, str) for n in found["parameter_names"] or ())
            require(path, own, "a header that none writes")
            _ = found["shapes"] is None or row_type(found["shapes"])
        return found

    def __len__(self) -> int:
        return sum(len(segment.rows) for segment in self._segments())

    @property
    def counts(self) -> dict[str, int]:
        """Number of rows by outcome."""
        status = [segment.rows["status"] for segment in self._segments()]
        return {
            o.name.lower(): sum(int((s == o).sum()) for s in status) for o in Outcome
        }

    @property
    def labels(self) -> list[str]:
        """Names of the proposals, in order of appearance; "" if not known."""
        return [*dict.fromkeys(segment.label for segment in self._segments())]

    @property
    def num_bytes(self) -> int:
        """Size on the disk."""
        return self._store.num_bytes

    def read(self, rows: Tensor | Sequence[int] | slice | None = None) -> Simulations:
        """Return rows.

        Args:
            rows: Positions, in any order and repeated where wanted; a slice; or a mask
                over all rows. None reads everything into memory.
        """
        names = "theta", "action", "x", "status"
        theta, action, x, status = self._gather(names, rows)
        return Simulations(theta, action, x, status)

    def chunks(self, size: int = 10_000) -> Iterator[Simulations]:
        """Yield all rows in order, at most ``size`` at a time.

        Of x, memory holds one segment, 4 MiB, and what is yielded. Rows added meanwhile
        are not seen.
        """
        if size < 1:
            raise ValueError(f"expected size >= 1; got {size}; pass 10_000")
        total = len(self)
        for start in range(0, total, size):
            yield self.read(slice(start, min(start + size, total)))

    def columns(self, *names: str) -> dict[str, Tensor]:
        """Return whole columns without the others.

        Args:
            names: Names of columns among ``theta``, ``action``, ``x``, ``status``,
                ``index`` (of the row in its run), ``seed`` (of the run; a row's own one
                is ``row_seeds(seed, 1, first=index)``), ``log_proposal``
                and ``label`` (an index into :attr:`labels`).
        """
        readable = {*COLUMNS, "seed", "label"}
        if unknown := {*names} - readable:
            raise ValueError(
                f"expected columns among {sorted(readable)}; got "
                f"{sorted(unknown)}; name those"
            )
        return dict(zip(names, self._gather(names), strict=True))

    def _segments(self, run: str | None = None) -> list[Segment]:
        """Return the segments as they are on the disk now, all or those of a run."""
        with self._store.reading():
            total = self._store.length(self._name)
            if self._generation != self._store.generation or total < len(self._found):
                self._found, self._last = [], (0, np.zeros(0))
                self._generation = self._store.generation
            if total > len(self._found):
                with sensible(self._store.path):
                    kind = row_type(self.header["shapes"])
                    for number in range(len(self._found) + 1, total + 1):
                        self._found.append(self._segment(number, kind))
        return [s for s in self._found if run in (None, s.run)]

    def _segment(self, number: int, kind: np.dtype) -> Segment:
        head = self._store.get(self._name, number) or b""
        text, _, content = head.partition(b"\n")
        known, rows = json.loads(text), np.frombuffer(content, kind)
        own = {name: type(value) for name, value in known.items()} == KNOWN
        own &= bool((rows["index"] >= 0).all())
        own &= bool((np.abs(rows["status"] - 1) <= 1).all())  # those of an outcome
        require(self._store.path, own, f"a segment {number} that no bank writes")
        return Segment(number, rows, **known)

    def _x(self, segment: Segment) -> np.ndarray:
        """Return what the rows of a segment measured; it cannot be written to."""
        if self._last[0] != segment.number:
            content = self._store.body(self._name, segment.number)
            with sensible(self._store.path):
                shape = len(segment.rows), *self.header["shapes"]["x"]
                x = np.frombuffer(content, "<f4").reshape(shape)
            self._last = segment.number, x
        return self._last[1]

    def _write(self, run: Mapping[str, Any], columns: Mapping[str, Tensor]) -> None:
        """Write those rows of a run that are not there, on the disk at the end.

        Raises:
            ValueError: If the rows have other shapes than those in the bank.
        """
        arrays = {name: c.detach().cpu().numpy() for name, c in columns.items()}
        shapes = {name: [*arrays[name].shape[1:]] for name in COLUMNS[:3]}
        header, x = self.header, arrays.pop("x")
        known = header["shapes"]
        if known not in (None, shapes) and self._segments():
            raise ValueError(
                f"expected rows of shapes {known}, as in the bank {self.path}; "
                f"got {shapes}; make a bank of its own for them"
            )
        index, first = np.unique(arrays["index"], return_index=True)
        stored = [s.rows["index"] for s in self._segments(run["run"])]
        fresh = np.sort(first[~np.isin(index, np.concatenate([index[:0], *stored]))])
        rows = np.empty(len(x), row_type(shapes))
        for name, array in arrays.items():
            rows[name] = array
        size = max(1, SEGMENT_BYTES // max(rows.itemsize + x[:1].nbytes, 1))
        with self._store.writing():
            if known != shapes:
                self._store.put(self._key, 0, {**header, "shapes": shapes})
            for start in range(0, len(fresh), size):
                part = fresh[start : start + size]
                head = json.dumps(run).encode() + b"\n" + rows[part].tobytes()
                self._store.append(self._name, head, x[part].astype("<f4").tobytes())

    def _gather(self, names: Sequence[str], rows: Any = None) -> list[Tensor]:
        """Return columns of some rows, or of all."""
        columns = []
        with self._store.reading():
            segments = self._segments()
            if not segments:
                raise ValueError(
                    f"expected rows in {self.path}; got none; simulate into it"
                )
            ends = np.cumsum([len(segment.rows) for segment in segments])
            places, labels = positions(rows, int(ends[-1])), self.labels
            which = np.searchsorted(ends, places, side="right")
            order = np.argsort(which, kind="stable")
            groups = np.split(order, np.flatnonzero(np.diff(which[order])) + 1)
            for name in names:
                column = np.zeros(0)
                for group in groups:
                    k = which[group[0]] if len(group) else 0  # of no rows, their type
                    values = self._values(name, segments[k], labels)
                    if not len(column):
                        column = np.empty((len(which), *values.shape[1:]), values.dtype)
                    column[group] = values[places[group] - ends[k]]  # from the end
                columns.append(torch.from_numpy(column))
        return columns

    def _values(self, name: str, segment: Segment, labels: list[str]) -> np.ndarray:
        """Return a column of a segment."""
        if name == "x":
            return self._x(segment)
        if name == "label":
            return np.full(len(segment.rows), labels.index(segment.label))
        if name != "seed":
            return segment.rows[name]
        if (num_bits := segment.seed.bit_length()) > 63:
            raise ValueError(
                "expected seeds below 2**63 for a column of them; got one of "
                f"{num_bits} bits; read the other columns"
            )
        return np.full(len(segment.rows), segment.seed)


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
    columns = {n: own_tensor(rows[n], torch.float32, name=n) for n in COLUMNS[:3]}
    columns |= {"status": rows["status"], "index": rows["index"]}
    lengths = {name: len(column) for name, column in columns.items()}
    if len({*lengths.values()}) > 1:
        raise ValueError(f"expected rows; got {lengths}; give columns of one length")
    log_proposal = torch.full((lengths["x"],), torch.nan, dtype=torch.float64)
    if proposal is not None:
        log_proposal = log_density(proposal, rows["theta"])
        num_outside = int((log_proposal == -torch.inf).sum())
        if num_outside:
            warn(
                f"SA305 {num_outside} of {lengths['x']} rows have density 0 under the "
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

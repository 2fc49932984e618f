"""Simulations on disk: append-only, larger than memory, whole at any moment.

Rows stand in segments, records of a store: those of one run that were written at once.
What they measured is a record of its own.
"""

from __future__ import annotations

import copy
import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.arrays import Array, own_tensor
from sbi_active.expected import require
from sbi_active.messages import warn
from sbi_active.simulation.bank.store import Store, whole
from sbi_active.simulation.fingerprint import fingerprint, require_same
from sbi_active.simulation.outcomes import Simulations
from sbi_active.support import log_density

#: Bytes of a segment: what reading one row may cost in memory. With 16 MiB, ten rows of
#: 1 MB one by one take four times the CPU, and nothing else takes less.
SEGMENT_BYTES = 4 * 2**20
SHAPED = "theta", "action", "x"


class Bank(AbstractContextManager["Bank"]):
    r"""Simulated rows on disk, to go on with, read in parts, and reuse.

    A row is theta, action, x, its outcome, the seed of its run, its index there, and
    the log density of the proposal that theta was drawn from. The position of a row
    never changes. One bank holds the rows of one simulator. What is read is in memory,
    but for x.

    Without ``simulator`` a bank is read, by any number of processes; with it, rows may
    be added, by one process at a time, from the first one written until :meth:`close`.

    Args:
        path: Folder, in which the bank is the file ``store.db``; made where there is
            none and ``simulator`` is given. Or the store of a campaign.
        simulator: Simulator of these rows. Its name, settings and source are compared
            with those in the bank.
        version: Version of the simulator, yours; given, it stands for the source code.
        name: Name of the bank in its file, which may hold several, as a campaign's
            does.

    Attributes:
        path: The folder.

    Raises:
        ValueError: If the folder holds no bank, one of another format, or one of
            another simulator.
        CorruptSegmentError: Here and wherever rows are read, if the file does not hold
            what was written, or is not there.

    Example:
        >>> from tempfile import TemporaryDirectory
        >>> def simulator(theta, action):
        ...     return 2 * theta
        >>> from sbi_active import simulate
        >>> rows = torch.rand(5, 1), torch.ones(5, 1)
        >>> with TemporaryDirectory() as folder:
        ...     with Bank(folder, simulator=simulator) as bank:
        ...         _ = simulate(simulator, *rows, seed=0, store=bank)
        ...     len(Bank(folder))
        5
    """

    def __init__(
        self,
        path: str | Path | Store,
        *,
        simulator: Callable[..., Any] | None = None,
        version: str = "",
        name: str = "rows",
    ) -> None:
        makes = simulator is not None
        self._store = path if isinstance(path, Store) else Store(Path(path), make=makes)
        self.path, self._name, self._key = self._store.folder, name, f"bank {name}"
        self._found: list[tuple[Array, str]] = []
        self._proposal: Distribution | None = None
        own = fingerprint(simulator, version=version) if simulator is not None else {}
        self._mine = own and {**own, "shapes": None}  # the header of a new bank
        _ = self.header

    def __exit__(self, *_: object) -> None:
        self.close()

    def __len__(self) -> int:
        return sum(len(rows) for rows, _ in self._segments())

    @property
    def header(self) -> dict[str, Any]:
        """Simulator, shapes and names, as they are on the disk."""
        store = self._store
        with store.reading():
            found = store.json(self._key) or self._mine
            _ = found and found["shapes"] and row_type(found["shapes"])
            there = [kind for kind in store.catalog if kind.startswith("bank ")]
        expected, got = f"the {self._key} in {store.path}", ", ".join(there) or "none"
        advice = "give name= of one there, or simulator= to make one"
        require(bool(found or not there), expected, got, advice)
        if self._mine:
            require_same(f"the bank {self.path}", found, self._mine)
        return found

    def table(self) -> Array:
        """Return all rows but for x, whose order never changes.

        Its fields are ``theta``, ``action``, ``status``, ``index`` (of the row in its
        run) and ``log_proposal``.
        """
        parts = [rows for rows, _ in self._segments()]
        require(bool(parts), f"rows in {self.path}", "none", "simulate into it")
        return np.concatenate(parts)

    def read(self, rows: Tensor | Sequence[int] | slice | None = None) -> Simulations:
        """Return rows.

        Args:
            rows: Positions, in any order and repeated where wanted; a slice; or a mask
                over all rows. None reads everything into memory.
        """
        table, chosen = self.table(), slice(None) if rows is None else rows
        chosen = chosen if isinstance(chosen, slice) else np.asarray(chosen)
        places = np.arange(len(table))[chosen]
        ends = np.cumsum([len(part) for part, _ in self._found])
        which = np.searchsorted(ends, places, side="right")
        x = np.empty((len(places), *self.header["shapes"]["x"]), np.float32)
        for k in map(int, np.unique(which)):
            own = which == k
            x[own] = self._x(k)[places[own] - ends[k]]  # from the segment's end
        found = {n: table[n][places] for n in ("theta", "action", "status")}
        tensors: Any = {n: torch.from_numpy(c) for n, c in {**found, "x": x}.items()}
        return Simulations(**tensors)

    def drawn_from(self, proposal: Distribution) -> Bank:
        """Return this bank as a store of simulations whose theta has one proposal.

        Rows that are stored without one cannot be reweighted.

        Args:
            proposal: Proposal that theta was drawn from.

        Example:
            ``simulate(..., store=bank.drawn_from(prior))``
        """
        known = copy.copy(self)
        known._proposal = proposal
        return known

    def load(self, run: str) -> tuple[Tensor, Tensor, Tensor] | None:
        """Return the stored rows of a run: index (k,), x (k, *x_shape), status (k,).

        Args:
            run: Name of the run.

        Returns:
            None if there is nothing.
        """
        own = [
            (rows["index"], self._x(k), rows["status"])
            for k, (rows, of) in enumerate(self._segments())
            if of == run
        ]
        columns = [torch.from_numpy(np.concatenate(c)) for c in zip(*own, strict=True)]
        return (columns[0], columns[1], columns[2]) if own else None

    def save(self, run: str, *, seed: int, **rows: Any) -> None:
        """Store rows of a run; they are on the disk when this returns.

        A row whose index is stored already is left as it is.

        Args:
            run: Name of the run: the same one for the same theta, action and seed.
            seed: Seed of the whole run.
            **rows: The rows, as keywords of :meth:`.RowStore.save`.

        Raises:
            ValueError: If the rows do not fit the bank, or it was opened to read.
            LockedError: If somebody else is writing.
            OSError: If the disk is full or cannot be written.
        """
        expected = "a bank opened with its simulator, to write to"
        require(bool(self._mine), expected, "one that is read", "give simulator=")
        self._store.acquire()
        columns = {n: own_tensor(rows[n], torch.float32, name=n) for n in SHAPED}
        columns |= {n: rows[n] for n in ("status", "index")}
        unknown = torch.full(columns["index"].shape, torch.nan, dtype=torch.float64)
        log_proposal = rows.get("log_proposal", unknown)
        if self._proposal is not None:
            log_proposal = log_density(self._proposal, rows["theta"])
        if num := int((log_proposal == -torch.inf).sum()):
            text = f"SA305 {num} of {len(log_proposal)} rows have density 0 under the"
            warn(f"{text} proposal: they were not drawn from it")
        columns["log_proposal"] = log_proposal
        arrays = {name: c.detach().cpu().numpy() for name, c in columns.items()}
        shapes = {name: [*arrays[name].shape[1:]] for name in SHAPED}
        header, segments, x = self.header, self._segments(), arrays.pop("x")
        same = header["shapes"] in (None, shapes) or not segments
        expected = f"rows of shapes {header['shapes']}, as in the bank {self.path}"
        require(same, expected, shapes, "make a bank of its own for them")
        stored = [r["index"] for r, of in segments if of == run]
        fresh = ~np.isin(arrays["index"], np.concatenate([*stored, []]))
        table = np.empty(len(x), row_type(shapes))
        for name, array in arrays.items():
            table[name] = array
        table, x = table[fresh], x[fresh].astype("<f4", copy=False)
        size = max(1, SEGMENT_BYTES // max(table.itemsize + x[:1].nbytes, 1))
        known = json.dumps({"run": run, "seed": int(seed)}).encode() + b"\n"
        with self._store.writing():
            self._store.put(self._key, {**header, "shapes": shapes})
            for k in range(0, len(table), size):
                self._store.append(self._name, known + table[k : k + size].tobytes())
                self._store.append(f"x of {self._name}", x[k : k + size].tobytes())

    def verify(self) -> None:
        """Compare every byte with its checksum.

        Raises:
            CorruptSegmentError: If the file does not hold what was written.
        """
        self._store.verify()

    def close(self) -> None:
        """Let others write. Reading goes on to work."""
        self._store.close()

    def _segments(self) -> list[tuple[Array, str]]:
        """Return rows but for x, and the name of their run, as on the disk now."""
        store = self._store
        with store.reading():
            total = store.catalog.get(self._name, 0)
            kind = row_type(self.header["shapes"]) if total > len(self._found) else None
            for number in range(len(self._found) + 1, total + 1):
                content = store.get(self._name, number) or b""
                text, _, content = content.partition(b"\n")
                run, rows = json.loads(text)["run"], np.frombuffer(content, kind)
                own = (np.abs(rows["status"] - 1) <= 1) & (rows["index"] >= 0)
                whole(store.path, bool(own.all()), f"a segment {number} of no bank")
                self._found.append((rows, run))
        return self._found

    def _x(self, k: int) -> Array:
        """Return what the rows of a segment measured; it cannot be written to."""
        with self._store.reading():
            content = self._store.get(f"x of {self._name}", k + 1) or b""
            shape = len(self._found[k][0]), *self.header["shapes"]["x"]
            return np.frombuffer(content, "<f4").reshape(shape)


def row_type(shapes: Mapping[str, Sequence[int]]) -> np.dtype:
    """Return the type of a row but for x."""
    tables = [(name, "<f4", tuple(shapes[name])) for name in ("theta", "action")]
    own = ("log_proposal", "<f8"), ("index", "<i8"), ("status", "i1")
    return np.dtype([*own, *tables])

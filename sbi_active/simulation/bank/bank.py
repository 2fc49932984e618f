"""Simulations on disk: append-only, larger than memory, whole at any moment.

Rows stand in segments, records of a store: those of one run that were written at once.
"""

from __future__ import annotations

import copy
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.arrays import Array, own_tensor
from sbi_active.expected import require
from sbi_active.messages import warn
from sbi_active.simulation.bank.errors import CorruptSegmentError, whole
from sbi_active.simulation.bank.store import Store
from sbi_active.simulation.fingerprint import fingerprint, require_same
from sbi_active.simulation.outcomes import Outcome, Simulations
from sbi_active.simulation.workers.store import run_digest
from sbi_active.support import log_density

#: Bytes of a segment: what reading one row may cost in memory. With 16 MiB, ten rows of
#: 1 MB one by one take four times the CPU, and nothing else takes less.
SEGMENT_BYTES = 4 * 2**20
SHAPED = "theta", "action", "x"
COLUMNS = {*SHAPED, "status", "index", "seed", "log_proposal", "label"}
KNOWN = {"run": str, "seed": int, "label": str}  # of all rows of a segment


class Bank:
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
        >>> theta = torch.rand(5, 1)
        >>> rows = Simulations(theta, torch.ones(5, 1), x=2 * theta)
        >>> with TemporaryDirectory() as folder:
        ...     with Bank(folder, simulator=simulator) as bank:
        ...         stored = bank.append(rows, seed=0)
        ...     stored, Bank(folder).counts
        (5, {'ok': 5, 'invalid': 0, 'missing': 0})
    """

    def __init__(
        self,
        path: str | Path | Store,
        *,
        simulator: Callable[..., Any] | None = None,
        version: str = "",
        name: str = "rows",
    ) -> None:
        self._writable = simulator is not None
        is_store = isinstance(path, Store)
        self._store = path if is_store else Store(Path(path), make=self._writable)
        self.path, self._name, self._key = self._store.folder, name, f"bank {name}"
        self._found: list[tuple[Array, dict[str, Any]]] = []
        self._last = -1, np.zeros(0)  # the segment whose x was read last
        self._proposal: tuple[Distribution | None, str] = (None, "")
        if simulator is not None:
            names = getattr(simulator, "parameter_names", None)
            mine = fingerprint(simulator, version=version)
            mine |= {"shapes": None, "parameter_names": names and [*names]}
            if self._store.json(self._key) is None:
                with self._store.writing():
                    if self._store.json(self._key) is None:  # nobody was faster
                        self._store.put(self._key, 0, mine)
                if not is_store:
                    self._store.close()
            require_same(f"the bank {self.path}", self.header, mine)
        _ = self.header

    def __enter__(self) -> Bank:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"Bank({str(self.path)!r}, name={self._name!r})"

    def __len__(self) -> int:
        return sum(len(rows) for rows, _ in self._segments())

    @property
    def header(self) -> dict[str, Any]:
        """Simulator, shapes and names, as they are on the disk."""
        store = self._store
        with store.reading():
            found = store.json(self._key) or {}
            _ = found and found["shapes"] and row_type(found["shapes"])
            there = [kind for kind in store.catalog if kind.startswith("bank ")]
        expected, got = f"the {self._key} in {store.path}", ", ".join(there) or "none"
        advice = "give name= of one there, or simulator= to make one"
        require(bool(found), expected, got, advice)
        return found

    @property
    def counts(self) -> dict[str, int]:
        """Number of rows by outcome."""
        status = [rows["status"] for rows, _ in self._segments()]
        found = {o: sum(int((part == o).sum()) for part in status) for o in Outcome}
        return {outcome.name.lower(): num for outcome, num in found.items()}

    @property
    def labels(self) -> list[str]:
        """Names of the proposals, in order of appearance; "" if not known."""
        return [*dict.fromkeys(run["label"] for _, run in self._segments())]

    def read(self, rows: Tensor | Sequence[int] | slice | None = None) -> Simulations:
        """Return rows.

        Args:
            rows: Positions, in any order and repeated where wanted; a slice; or a mask
                over all rows. None reads everything into memory.
        """
        found: dict[str, Any] = self._gather((*SHAPED, "status"), rows)
        return Simulations(**found)

    def columns(self, *names: str) -> dict[str, Tensor]:
        """Return whole columns without the others.

        Args:
            names: Names of columns among ``theta``, ``action``, ``x``, ``status``,
                ``index`` (of the row in its run), ``seed`` (of the run; a row's own one
                is ``row_seeds(seed, 1, first=index)``), ``log_proposal``
                and ``label`` (an index into :attr:`labels`).
        """
        return self._gather(names)

    def append(
        self,
        simulations: Simulations,
        *,
        seed: int,
        proposal: Distribution | None = None,
        label: str | None = None,
    ) -> int:
        """Store simulations; they are on the disk when this returns.

        Args:
            simulations: Simulations of this bank's simulator.
            seed: Seed that they were simulated with.
            proposal: Proposal that theta was drawn from; None if it is not known,
                and then the rows cannot be reweighted.
            label: Label of the proposal, "prior" or "round 3"; given with it.

        Returns:
            Number of rows stored: those of a seed, theta and action are stored once.
        """
        before, rows = len(self), {**vars(simulations)}
        run = run_digest(seed, rows["theta"], rows["action"])
        rows["index"] = torch.arange(len(simulations))
        self.drawn_from(proposal, label=label).save(run, seed=seed, **rows)
        return len(self) - before

    def drawn_from(self, proposal: Distribution | None, *, label: str | None) -> Bank:
        """Return this bank as a store of simulations whose theta has one proposal.

        Args:
            proposal: Proposal that theta was drawn from, as in :meth:`append`.
            label: Label of the proposal, as in :meth:`append`.

        Example:
            ``simulate(..., store=bank.drawn_from(prior, label="prior"))``
        """
        labeled = copy.copy(self)
        labeled._proposal = proposal, label or ""
        return labeled

    def load(self, run: str) -> tuple[Tensor, Tensor, Tensor] | None:
        """Return the stored rows of a run: index (k,), x (k, *x_shape), status (k,).

        Args:
            run: Name of the run.

        Returns:
            None if there is nothing.
        """
        own = [np.full(len(r), known["run"] == run) for r, known in self._segments()]
        if not any(map(np.any, own)):
            return None
        found = self._gather(("index", "x", "status"), np.concatenate(own))
        return found["index"], found["x"], found["status"]

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
        require(self._writable, expected, f"{self}, which reads", "give simulator=")
        self._store.acquire()
        proposal, label = self._proposal
        columns = {n: own_tensor(rows[n], torch.float32, name=n) for n in SHAPED}
        columns |= {"status": rows["status"], "index": rows["index"]}
        log_proposal = torch.full((len(columns["x"]),), torch.nan, dtype=torch.float64)
        if proposal is not None:
            log_proposal = log_density(proposal, rows["theta"])
        if num := int((log_proposal == -torch.inf).sum()):
            text = f"SA305 {num} of {len(log_proposal)} rows have density 0 under the"
            warn(f"{text} proposal {label!r}: they were not drawn from it")
        known = {"run": run, "seed": int(seed), "label": label}
        self._write(known, {**columns, "log_proposal": log_proposal})

    def verify(self) -> list[str]:
        """Return the first problem of the file; none where all is well.

        Every byte of every column is compared with its checksum.
        """
        try:
            self._store.verify()
            for k in range(len(self._segments())):
                self._x(k)
        except CorruptSegmentError as error:
            return [str(error)]
        return []

    def close(self) -> None:
        """Let others write. Reading goes on to work."""
        self._store.close()

    def _segments(self) -> list[tuple[Array, dict[str, Any]]]:
        """Return rows but for x, and what is known of their run, as on the disk now."""
        store = self._store
        with store.reading():
            total = store.length(self._name)
            if total < len(self._found):  # another file, as from a copy
                self._found, self._last = [], (-1, np.zeros(0))
            kind = row_type(self.header["shapes"]) if total > len(self._found) else None
            for number in range(len(self._found) + 1, total + 1):
                head = store.get(self._name, number) or b""
                text, _, content = head.partition(b"\n")
                known, rows = json.loads(text), np.frombuffer(content, kind)
                own = {name: type(value) for name, value in known.items()} == KNOWN
                own &= bool((np.abs(rows["status"] - 1) <= 1).all())
                own &= bool((rows["index"] >= 0).all())
                whole(store.path, own, f"a segment {number} that no bank writes")
                self._found.append((rows, known))
        return self._found

    def _x(self, k: int) -> Array:
        """Return what the rows of a segment measured; it cannot be written to."""
        if self._last[0] != k:
            with self._store.reading():
                content = self._store.get(self._name, k + 1, part="body") or b""
                shape = len(self._found[k][0]), *self.header["shapes"]["x"]
                self._last = k, np.frombuffer(content, "<f4").reshape(shape)
        return self._last[1]

    def _write(self, run: dict[str, Any], columns: dict[str, Tensor]) -> None:
        """Write those rows of a run that are not there, on the disk at the end."""
        arrays = {name: c.detach().cpu().numpy() for name, c in columns.items()}
        shapes = {name: [*arrays[name].shape[1:]] for name in SHAPED}
        header, segments, x = self.header, self._segments(), arrays.pop("x")
        same = header["shapes"] in (None, shapes) or not segments
        expected = f"rows of shapes {header['shapes']}, as in the bank {self.path}"
        require(same, expected, shapes, "make a bank of its own for them")
        stored = [r["index"] for r, known in segments if known["run"] == run["run"]]
        fresh = ~np.isin(arrays["index"], np.concatenate([*stored, []]))
        rows = np.empty(len(x), row_type(shapes))
        for name, array in arrays.items():
            rows[name] = array
        rows, x = rows[fresh], x[fresh].astype("<f4", copy=False)
        size = max(1, SEGMENT_BYTES // max(rows.itemsize + x[:1].nbytes, 1))
        with self._store.writing():
            self._store.put(self._key, 0, {**header, "shapes": shapes})
            for k in range(0, len(rows), size):
                head = json.dumps(run).encode() + b"\n" + rows[k : k + size].tobytes()
                self._store.append(self._name, head, x[k : k + size].tobytes())

    def _gather(self, names: Sequence[str], rows: Any = None) -> dict[str, Tensor]:
        """Return columns of some rows, or of all."""
        unknown, segments = {*names} - COLUMNS, self._segments()
        require(not unknown, f"columns among {COLUMNS}", unknown, "name one of these")
        require(bool(segments), f"rows in {self}", "none", "simulate into it")
        ends = np.cumsum([len(segment) for segment, _ in segments])
        places = positions(rows, int(ends[-1]))
        which = np.searchsorted(ends, places, side="right")
        found: dict[str, Array] = {}
        for k in np.unique(which) if len(places) else (0,):
            own, start = which == k, ends[k] - len(segments[k][0])
            for name in names:
                values = self._values(name, int(k))[places[own] - start]
                empty = np.empty((len(places), *values.shape[1:]), values.dtype)
                found.setdefault(name, empty)[own] = values
        return {name: torch.from_numpy(column) for name, column in found.items()}

    def _values(self, name: str, k: int) -> Array:
        """Return a column of a segment."""
        rows, known = self._found[k]
        if name == "x":
            return self._x(k)
        if name == "label":
            return np.full(len(rows), self.labels.index(known["label"]))
        if name == "seed":
            is_small, got = known["seed"] < 2**63, f"one of {known['seed']:.3g}"
            require(is_small, "seeds below 2**63 for a column", got, "read the others")
            return np.full(len(rows), known["seed"])
        return rows[name]


def row_type(shapes: Mapping[str, Sequence[int]]) -> np.dtype:
    """Return the type of a row but for x, whose shape is looked at as well."""
    theta, action, _ = (np.empty((0, *shapes[name])).shape[1:] for name in SHAPED)
    tables = ("theta", "<f4", theta), ("action", "<f4", action)
    own = ("log_proposal", "<f8"), ("index", "<i8"), *tables, ("status", "i1")
    return np.dtype([*own])


def positions(rows: Any, total: int) -> Array:
    """Return the positions of rows, as an array of all of them is indexed.

    Args:
        rows: Positions, a slice, a mask over all rows, or None for all.
        total: Number of all rows.

    Raises:
        ValueError: If they are anything else.
    """
    rows = slice(None) if rows is None else rows
    try:
        return np.arange(total)[rows if isinstance(rows, slice) else np.asarray(rows)]
    except IndexError as error:
        text = f"expected positions of rows within [0, {total}), or a mask of {total}"
        raise ValueError(f"{text}; got {rows!r}; pass row numbers") from error

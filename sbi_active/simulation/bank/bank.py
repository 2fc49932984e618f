"""Simulations on disk: append-only, larger than memory, whole at any moment."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.simulation.bank.damage import CorruptSegmentError
from sbi_active.simulation.bank.fingerprint import fingerprint, simulator_name
from sbi_active.simulation.bank.header import (
    has_header,
    make_folder,
    new_header,
    read_header,
    require_same_simulator,
    write_header,
)
from sbi_active.simulation.bank.labeled import LabeledStore
from sbi_active.simulation.bank.lock import WriterLock
from sbi_active.simulation.bank.rows import StoredIndex, positions
from sbi_active.simulation.bank.shelf import COLUMN_NAMES, Shelf
from sbi_active.simulation.outcomes import Outcome, Simulations
from sbi_active.simulation.workers.store import StoredRows, run_digest

if TYPE_CHECKING:
    from typing_extensions import Unpack


class Bank:
    r"""Simulated rows on disk, to go on with, read in parts, and reuse.

    A row is theta, action, x, its outcome, the seed of its run, its index there, and
    the log density of the proposal that theta was drawn from. The position of a row
    never changes. One bank holds the rows of one simulator.

    Without ``simulator`` a bank is read, by any number of processes; with it, rows may
    be added, by one process at a time, from the first row added until :meth:`close`.

    Args:
        path: Folder; made where there is none and ``simulator`` is given.
        simulator: Whose rows these are. Its name, settings and source are compared
            with those in the bank.
        version: Of the simulator, yours; given, it stands for the source code.
        parameter_names: One a parameter; None takes those of the simulator.
        created: Date to note in a new bank.

    Attributes:
        path: The folder.

    Raises:
        ValueError: If the folder holds no bank, one of another format, or one of
            another simulator.
        CorruptSegmentError: Here and wherever rows are read, if a file does not hold
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
        path: str | Path,
        *,
        simulator: Callable[..., Any] | None = None,
        version: str = "",
        parameter_names: Sequence[str] | None = None,
        created: str | None = None,
    ) -> None:
        self.path = Path(path)
        self._writable = simulator is not None
        self._stored: StoredIndex | None = None  # of the run being written
        self._lock = WriterLock(self.path)
        if simulator is None:
            self._shelf = Shelf(self.path / "segments", read_header(self.path))
            return
        if parameter_names is None:
            parameter_names = getattr(simulator, "parameter_names", None)
        names = None if parameter_names is None else [*parameter_names]
        header = new_header(
            fingerprint(simulator, version=version), names=names, created=created
        )
        if not has_header(self.path):
            make_folder(self.path, "segments")
            with self._lock:
                if not has_header(self.path):  # nobody was faster
                    write_header(self.path, header)
        self._shelf = Shelf(self.path / "segments", read_header(self.path))
        require_same_simulator(self.path, self.header, header)

    def __len__(self) -> int:
        return sum(segment.num_rows for segment in self._shelf.segments())

    def __enter__(self) -> Bank:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        try:
            return f"Bank({str(self.path)!r}: {len(self)} rows)"
        except CorruptSegmentError as error:
            return f"Bank({str(self.path)!r}: {error.reason})"

    @property
    def header(self) -> dict[str, Any]:
        """Format, simulator, shapes and names, as last read."""
        return dict(self._shelf.header)

    @property
    def simulator_name(self) -> str:
        """Qualified name of the simulator, and of the function that it wraps."""
        return simulator_name(self.header)

    @property
    def counts(self) -> dict[str, int]:
        """Number of rows by outcome."""
        segments = self._shelf.segments()
        counts = {o: sum(s.meta["counts"][o] for s in segments) for o in Outcome}
        return {outcome.name.lower(): count for outcome, count in counts.items()}

    @property
    def labels(self) -> list[str]:
        """Names of the proposals, in order of appearance; "" where not known."""
        runs = (run for segment in self._shelf.segments() for run in segment.runs)
        return [*dict.fromkeys(run["label"] for run in runs)]

    @property
    def num_bytes(self) -> int:
        """Size on the disk."""
        return sum(segment.num_bytes for segment in self._shelf.segments())

    def append(
        self,
        simulations: Simulations,
        *,
        seed: int,
        proposal: Distribution | None = None,
        label: str | None = None,
        log_action: float | Tensor = float("nan"),
    ) -> int:
        """Store simulations; they are on the disk when this returns.

        Args:
            simulations: Of this bank's simulator.
            seed: That they were simulated with.
            proposal: That theta was drawn from; None where it is not known, and then
                the rows cannot be reweighted.
            label: Of the proposal, "prior" or "round 3"; given with it.
            log_action: Log density, or log mass, of the actions, a number or (n,).

        Returns:
            Number of rows stored, less than n where rows of the same theta, action and
            seed are there already, as those of ``simulate(..., store=bank)`` are.
        """
        before = len(self)
        self.drawn_from(proposal, label=label, log_action=log_action).save(
            run_digest(seed, simulations.theta, simulations.action),
            index=torch.arange(len(simulations)),
            theta=simulations.theta,
            action=simulations.action,
            x=simulations.x,
            status=simulations.status,
            seed=seed,
        )
        return len(self) - before

    def drawn_from(
        self,
        proposal: Distribution | None,
        *,
        label: str | None,
        log_action: float | Tensor = float("nan"),
    ) -> LabeledStore:
        """Return this bank as a store for simulations whose theta has one proposal.

        Args:
            proposal: As in :meth:`append`.
            label: As in :meth:`append`.
            log_action: As in :meth:`append`; a tensor is indexed as the run's rows are.

        Example:
            ``simulate(..., store=bank.drawn_from(prior, label="prior"))``
        """
        if (proposal is None) != (not label):
            raise ValueError(
                f"expected a proposal and its label together; got {proposal!r} and "
                f"{label!r}; name the proposal, as in label='round 3'"
            )
        return LabeledStore(self, proposal, label or "", torch.as_tensor(log_action))

    def load(self, run: str) -> tuple[Tensor, Tensor, Tensor] | None:
        """Return what is stored of a run: index (k,), x (k, *x_shape), status (k,).

        Args:
            run: Name of the run.

        Returns:
            None where there is nothing.
        """
        parts = []
        for segment in self._shelf.segments():
            codes = [c for c, r in enumerate(segment.runs) if r["digest"] == run]
            if not codes:
                continue
            columns = segment.read(["run", "index", "x", "status"])
            mine = np.isin(columns["run"], codes)
            parts.append([columns[name][mine] for name in ("index", "x", "status")])
        if not parts:
            return None
        index, x, status = (
            np.concatenate(arrays) for arrays in zip(*parts, strict=True)
        )
        return torch.from_numpy(index), torch.from_numpy(x), torch.from_numpy(status)

    def save(self, run: str, **rows: Unpack[StoredRows]) -> None:
        """Store rows of a run; they are on the disk when this returns.

        A row whose index is stored already is left as it is.

        Args:
            run: Name of the run: the same one for the same theta, action and seed.
            **rows: The rows, as keywords of :class:`.StoredRows`.

        Raises:
            ValueError: If the rows do not fit the bank, or it was opened to read.
            LockedError: If somebody else is writing.
            OSError: If the disk is full or cannot be written.
        """
        self.drawn_from(None, label=None).save(run, **rows)

    def read(self, rows: Tensor | Sequence[int] | slice | None = None) -> Simulations:
        """Return rows.

        Args:
            rows: Positions, in any order and repeated where wanted; a slice; or a mask
                over all rows. None reads everything into memory.
        """
        names = ["theta", "action", "x", "status"]
        columns = self._shelf.gather(names, positions(rows, len(self)))
        theta, action, x, status = (torch.from_numpy(columns[n]) for n in names)
        return Simulations(theta, action, x, status)

    def chunks(self, size: int = 10_000) -> Iterator[Simulations]:
        """Yield all rows in order, at most ``size`` at a time.

        Memory holds one segment, 64 MiB, and what is yielded. Rows added meanwhile are
        not seen.
        """
        if size < 1:
            raise ValueError(f"expected size >= 1; got {size}; pass 10_000")
        total = len(self)
        for start in range(0, total, size):
            yield self.read(slice(start, min(start + size, total)))

    def columns(self, *names: str) -> dict[str, Tensor]:
        """Return whole columns without the others.

        Args:
            names: Among ``theta``, ``action``, ``x``, ``status``, ``index`` (of the row
                in its run), ``seed`` (of the run; a row's own one is
                ``row_seeds(seed, 1, first=index)``), ``log_proposal``, ``log_action``
                and ``label`` (an index into :attr:`labels`).
        """
        if unknown := {*names} - COLUMN_NAMES:
            raise ValueError(
                f"expected columns among {sorted(COLUMN_NAMES)}; got "
                f"{sorted(unknown)}; name those"
            )
        columns = self._shelf.gather([*names], None)
        return {name: torch.from_numpy(columns[name]) for name in names}

    def verify(self) -> list[str]:
        """Return what is wrong with the files, one line each; none where all is well.

        Every byte of every column is compared with its checksum.
        """
        return self._shelf.verify()

    def compact(self) -> None:
        """Merge small segments, as is done by itself now and then; safe at any moment.

        Raises:
            LockedError: If somebody else is writing.
        """
        self._require_lock()
        self._shelf.compact()

    def repair(self) -> list[str]:
        """Give up files that are damaged or lost, so that the others count again.

        Damaged ones are renamed to end in ".damaged". The rows after those that are
        lost move up; ``simulate(..., store=bank)`` simulates lost ones again. Returns
        what was wrong, as :meth:`verify` does; raises as :meth:`compact` does.
        """
        self._require_lock(clean=False)
        problems = self.verify()
        self._shelf.set_aside()
        self._note(num_segments=self._shelf.last_number())
        self._note(lost=self._shelf.lost())
        self._stored = None
        return problems

    def close(self) -> None:
        """Let others write. Reading goes on to work."""
        if self._lock.held:
            # From now on it is noticed if the last of them are not there.
            number = max(self._shelf.last_number(), self.header["num_segments"])
            with suppress(OSError):  # a full disk must not keep the lock
                self._note(num_segments=number)
            self._lock.release()

    def _note(self, **entries: Any) -> None:
        """Change entries of the header, here and on the disk."""
        header = {**self._shelf.header, **entries}
        if header != self._shelf.header:
            write_header(self.path, header)
            self._shelf.header = header

    def _require_lock(self, *, clean: bool = True) -> None:
        if not self._writable:
            raise ValueError(
                f"expected a bank opened with its simulator, to write to; got "
                f"Bank({str(self.path)!r}), which reads; open it by "
                f"Bank({str(self.path)!r}, simulator=...)"
            )
        if not self._lock.held:
            self._lock.acquire()
            # Others may have written meanwhile.
            self._stored = None
            self._shelf.header = read_header(self.path)
            if clean:
                self._shelf.clean()

    def store(self, run: dict[str, Any], columns: dict[str, np.ndarray]) -> None:
        """Write those rows of a run that are not there; see :meth:`save`."""
        self._require_lock()
        self._require_shapes(columns)
        if self._stored is None or self._stored.run != run["digest"]:
            self._stored = StoredIndex(run["digest"])
            before = self.load(run["digest"])
            if before is not None:
                self._stored.add(before[0].numpy())
        fresh = self._stored.unseen(columns["index"])
        if fresh.any():
            self._shelf.add(run, {name: c[fresh] for name, c in columns.items()})
            self._stored.add(columns["index"])

    def _require_shapes(self, columns: dict[str, np.ndarray]) -> None:
        shapes = {k: [*columns[k].shape[1:]] for k in ("theta", "action", "x")}
        if self.header["shapes"] == shapes:
            return
        if self.header["shapes"] is None or not len(self):
            self._note(shapes=shapes)
            return
        raise ValueError(
            f"expected rows of shapes {self.header['shapes']}, as in the bank "
            f"{self.path}; got {shapes}; make a bank of its own for them"
        )

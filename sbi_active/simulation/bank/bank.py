"""Simulations on disk: append-only, larger than memory, whole at any moment."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.simulation.bank.damage import CorruptSegmentError
from sbi_active.simulation.bank.fingerprint import (
    differences,
    fingerprint,
    simulator_name,
)
from sbi_active.simulation.bank.labeled import LabeledStore
from sbi_active.simulation.bank.rows import Rows, positions
from sbi_active.simulation.bank.segments import COLUMNS, SEGMENT_BYTES, write_segment
from sbi_active.simulation.bank.sqlite import OBJECTS
from sbi_active.simulation.bank.store import Store
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
        path: Folder, in which the bank is the file ``store.db``; made where there is
            none and ``simulator`` is given. Or the store of a campaign.
        simulator: Simulator of these rows. Its name, settings and source are compared
            with those in the bank.
        version: Version of the simulator, yours; given, it stands for the source code.
        parameter_names: Names of the parameters; None takes those of the simulator.
        created: Date to note in a new bank.
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
        parameter_names: Sequence[str] | None = None,
        created: str | None = None,
        name: str = "rows",
    ) -> None:
        makes = simulator is not None
        self._store = path if isinstance(path, Store) else Store(Path(path), make=makes)
        self.path, self._writable = self._store.folder, makes
        self._rows = Rows(self._store, name)
        self._stored: tuple[str, np.ndarray] = ("", np.zeros(0, bool))  # of a run
        if simulator is None:
            _ = self.header
            return
        if parameter_names is None:
            parameter_names = getattr(simulator, "parameter_names", None)
        mine = {
            "created": created,
            **fingerprint(simulator, version=version),
            "parameter_names": None if parameter_names is None else [*parameter_names],
            "shapes": None,
            "lost": [],  # segments that were given up
        }
        key = self._rows.key
        if self._store.text(key) is None:
            is_held = self._store.held
            with self._store.writing():
                if self._store.text(key) is None:  # nobody was faster
                    self._store.put(OBJECTS, key, 0, mine)
            if not is_held:
                self._store.close()
        self._require_same_simulator(mine)

    def __len__(self) -> int:
        return sum(segment.num_rows for segment in self._rows.segments())

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
        """Simulator, shapes and names, as they are on the disk."""
        return self._rows.header

    @property
    def simulator_name(self) -> str:
        """Qualified name of the simulator, and of the function that it wraps."""
        return simulator_name(self.header)

    @property
    def counts(self) -> dict[str, int]:
        """Number of rows by outcome."""
        counts = zip(*(s.counts for s in self._rows.segments()), strict=True)
        sums = [*map(sum, counts)] or [0] * len(Outcome)
        return {o.name.lower(): n for o, n in zip(Outcome, sums, strict=True)}

    @property
    def labels(self) -> list[str]:
        """Names of the proposals, in order of appearance; "" if not known."""
        return [*dict.fromkeys(segment.label for segment in self._rows.segments())]

    @property
    def num_bytes(self) -> int:
        """Size on the disk."""
        return self._store.num_bytes

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
            simulations: Simulations of this bank's simulator.
            seed: Seed that they were simulated with.
            proposal: Proposal that theta was drawn from; None if it is not known,
                and then the rows cannot be reweighted.
            label: Label of the proposal, "prior" or "round 3"; given with it.
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
        """Return this bank as a store of simulations whose theta has one proposal.

        Args:
            proposal: Proposal that theta was drawn from, as in :meth:`append`.
            label: Label of the proposal, as in :meth:`append`.
            log_action: Log density of the actions, as in :meth:`append`; a tensor is
                indexed as the run's rows are.

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
        """Return the stored rows of a run: index (k,), x (k, *x_shape), status (k,).

        Args:
            run: Name of the run.

        Returns:
            None if there is nothing.
        """
        parts = []
        for segment in self._rows.segments():
            if segment.run == run:
                columns = self._rows.columns(segment, ("index", "x", "status"))
                parts.append([columns[n] for n in ("index", "x", "status")])
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
        found = self._rows.gather(names, positions(rows, len(self)))
        theta, action, x, status = found
        return Simulations(theta, action, x, status)

    def chunks(self, size: int = 10_000) -> Iterator[Simulations]:
        """Yield all rows in order, at most ``size`` at a time.

        Memory holds one segment, 4 MiB, and what is yielded. Rows added meanwhile are
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
            names: Names of columns among ``theta``, ``action``, ``x``, ``status``,
                ``index`` (of the row in its run), ``seed`` (of the run; a row's own one
                is ``row_seeds(seed, 1, first=index)``), ``log_proposal``,
                ``log_action`` and ``label`` (an index into :attr:`labels`).
        """
        readable = {*COLUMNS} | {"seed", "label"}
        if unknown := {*names} - readable:
            raise ValueError(
                f"expected columns among {sorted(readable)}; got "
                f"{sorted(unknown)}; name those"
            )
        return dict(zip(names, self._rows.gather([*names], None), strict=True))

    def verify(self) -> list[str]:
        """Return the problems of the file, one line each; none where all is well.

        Every byte of every column is compared with its checksum.
        """
        wrong = [*self._store.problems(), *self._rows.damaged().values()]
        return [f"{self._store.path}: {reason}" for reason in wrong]

    def repair(self) -> list[str]:
        """Give up segments that are damaged or lost, so that the others count again.

        The file before is kept, its name ending in ".damaged". The rows after those
        that are lost move up; ``simulate(..., store=bank)`` simulates lost ones again.

        Returns:
            The problems, as :meth:`verify` returns them.

        Raises:
            LockedError: If somebody else is writing.
        """
        self._require_lock()
        problems = self.verify()
        self._store.salvage()
        lost = sorted({*self.header["lost"], *self._rows.damaged()})
        self._rows.note(lost=lost)
        return problems

    def close(self) -> None:
        """Let others write. Reading goes on to work."""
        self._store.close()

    def store(self, run: dict[str, Any], columns: dict[str, np.ndarray]) -> None:
        """Write those rows of a run that are not there; see :meth:`save`."""
        self._require_lock()
        index, name = columns["index"], run["run"]
        self._require_shapes(columns)
        if self._stored[0] != name:
            before = self.load(name)
            self._stored = name, _mask(np.zeros(0, bool), before and before[0].numpy())
        mask = np.pad(self._stored[1], (0, _room(self._stored[1], index)))
        fresh = np.zeros(len(index), bool)
        fresh[np.unique(index, return_index=True)[1]] = True
        rows = np.flatnonzero(fresh & ~mask[index])
        row_bytes = sum(column[:1].nbytes for column in columns.values())
        size = max(1, SEGMENT_BYTES // max(row_bytes, 1))
        with self._store.writing():
            for start in range(0, len(rows), size):
                some = rows[start : start + size]
                part = {key: column[some] for key, column in columns.items()}
                write_segment(self._store, self._rows.name, run, part)
        self._stored = name, _mask(mask, index)

    def _require_same_simulator(self, mine: dict[str, Any]) -> None:
        header = self.header
        lines = differences(header, mine)
        names = header["parameter_names"], mine["parameter_names"]
        if None not in names and names[0] != names[1]:
            lines.append(f"parameter names {names[0]} there, {names[1]} here")
        if lines:
            raise ValueError(
                f"expected the simulator of the bank {self.path}; got another: "
                f"{'; '.join(lines)}; make a bank for each simulator, or, where x is "
                "the same, give the same version= each time and keep what changes from "
                "call to call in attributes with a leading underscore"
            )

    def _require_lock(self) -> None:
        if not self._writable:
            raise ValueError(
                f"expected a bank opened with its simulator, to write to; got "
                f"Bank({str(self.path)!r}), which reads; open it by "
                f"Bank({str(self.path)!r}, simulator=...)"
            )
        if not self._store.held:
            self._store.acquire()
            self._stored = ("", np.zeros(0, bool))  # others may have written meanwhile

    def _require_shapes(self, columns: dict[str, np.ndarray]) -> None:
        header = self.header
        shapes = {k: [*columns[k].shape[1:]] for k in ("theta", "action", "x")}
        if header["shapes"] == shapes:
            return
        if header["shapes"] is not None and len(self):
            raise ValueError(
                f"expected rows of shapes {header['shapes']}, as in the bank "
                f"{self.path}; got {shapes}; make a bank of its own for them"
            )
        self._rows.note(shapes=shapes)


def _room(mask: np.ndarray, index: np.ndarray) -> int:
    return max(0, int(index.max(initial=-1)) + 1 - len(mask))


def _mask(mask: np.ndarray, index: np.ndarray | None) -> np.ndarray:
    """Return a mask over the rows of a run that are stored, with more of them."""
    if index is not None:
        mask = np.pad(mask, (0, _room(mask, index)))
        mask[index] = True
    return mask

"""Simulations on disk: append-only, larger than memory, whole at any moment."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.simulation.bank.fingerprint import (
    differences,
    fingerprint,
    simulator_name,
)
from sbi_active.simulation.bank.rows import (
    Rows,
    columns_of,
)
from sbi_active.simulation.bank.sqlite import CorruptSegmentError, sensible
from sbi_active.simulation.bank.store import Store
from sbi_active.simulation.outcomes import Simulations
from sbi_active.simulation.workers.store import run_digest


class Bank(Rows):
    r"""Simulated rows on disk, to go on with, read in parts, and reuse.

    A row is theta, action, x, its outcome, the seed of its run, its index there, and
    the log density of the proposal that theta was drawn from. The position of a row
    never changes. One bank holds the rows of one simulator. What is read is in memory,
    but for x.

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
        self._writable = simulator is not None
        is_store = isinstance(path, Store)
        store = path if is_store else Store(Path(path), make=self._writable)
        super().__init__(store, name)
        self._proposal: tuple[Distribution | None, str] = (None, "")
        if simulator is None:
            _ = self.header
            return
        names = parameter_names or getattr(simulator, "parameter_names", None)
        mine = {
            "created": created,
            **fingerprint(simulator, version=version),
            "parameter_names": None if names is None else [*names],
            "shapes": None,
        }
        if self._store.get(self._key) is None:
            is_held = self._store.held
            with self._store.writing():
                if self._store.get(self._key) is None:  # nobody was faster
                    self._store.put(self._key, 0, mine)
            if not is_held:
                self._store.close()
        self._require_same_simulator(mine)

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
    def simulator_name(self) -> str:
        """Qualified name of the simulator, and of the function that it wraps."""
        return simulator_name(self.header)

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
        before = len(self)
        self.drawn_from(proposal, label=label).save(
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
    ) -> Bank:
        """Return this bank as a store of simulations whose theta has one proposal.

        Args:
            proposal: Proposal that theta was drawn from, as in :meth:`append`.
            label: Label of the proposal, as in :meth:`append`.

        Example:
            ``simulate(..., store=bank.drawn_from(prior, label="prior"))``
        """
        if (proposal is None) != (not label):
            raise ValueError(
                f"expected a proposal and its label together; got {proposal!r} and "
                f"{label!r}; name the proposal, as in label='round 3'"
            )
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
        own = self._segments(run)
        if not own:
            return None
        # Copies, since torch takes no column of a table of one row.
        columns = ([s.rows["index"] for s in own], [self._x(s) for s in own])
        columns = (*columns, [s.rows["status"] for s in own])
        index, x, status = (torch.from_numpy(np.concatenate(c)) for c in columns)
        return index, x, status

    def save(self, run: str, **rows: Any) -> None:
        """Store rows of a run; they are on the disk when this returns.

        A row whose index is stored already is left as it is.

        Args:
            run: Name of the run: the same one for the same theta, action and seed.
            **rows: The rows, as keywords of :meth:`.RowStore.save`.

        Raises:
            ValueError: If the rows do not fit the bank, or it was opened to read.
            LockedError: If somebody else is writing.
            OSError: If the disk is full or cannot be written.
        """
        self._require_lock()
        proposal, label = self._proposal
        known = {"run": run, "seed": int(rows["seed"]), "label": label}
        self._write(known, columns_of(rows, proposal, label))

    def verify(self) -> list[str]:
        """Return the problems of the file, one line each; none where all is well.

        Every byte of every column is compared with its checksum.
        """
        wrong = self._store.problems()
        try:
            for segment in [] if wrong else self._segments():
                self._x(segment)
        except CorruptSegmentError as error:
            wrong = [error.reason]
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
        return problems

    def close(self) -> None:
        """Let others write. Reading goes on to work."""
        self._store.close()

    def _require_same_simulator(self, mine: dict[str, Any]) -> None:
        header = self.header
        with sensible(self._store.path):
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
                "expected a bank opened with its simulator, to write to; got "
                f"{self!r}, which reads; open it with simulator="
            )
        self._store.acquire()

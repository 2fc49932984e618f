"""A bank that notes the proposal of what is stored through it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol

import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.arrays import own_tensor
from sbi_active.messages import warn
from sbi_active.simulation.bank.log_density import log_density
from sbi_active.simulation.workers.store import StoredRows

if TYPE_CHECKING:
    from typing_extensions import Unpack


class Rows(Protocol):
    """The bank that keeps rows."""

    def load(self, run: str) -> tuple[Tensor, Tensor, Tensor] | None:
        """Return the stored rows of a run."""
        ...

    def store(self, run: dict[str, Any], columns: dict[str, NDArray[Any]]) -> None:
        """Store columns of a run's rows."""
        ...


class LabeledStore:
    """A bank that notes which proposal theta was drawn from; see ``drawn_from``."""

    def __init__(
        self, bank: Rows, proposal: Distribution | None, label: str, log_action: Tensor
    ) -> None:
        self._bank = bank
        self._proposal, self._label, self._log_action = proposal, label, log_action

    def load(self, run: str) -> tuple[Tensor, Tensor, Tensor] | None:
        """Return the stored rows of a run, as :meth:`.Bank.load` does."""
        return self._bank.load(run)

    def save(self, run: str, **rows: Unpack[StoredRows]) -> None:
        """Store rows of a run, as :meth:`.Bank.save` does."""
        index, theta, seed = rows["index"], rows["theta"], rows["seed"]
        columns = {name: rows[name] for name in ("theta", "action", "x", "status")}
        if any(len(column) != len(index) for column in columns.values()):
            lengths = {name: len(column) for name, column in columns.items()}
            raise ValueError(
                f"expected {len(index)} rows, one an index; got {lengths}; give "
                "columns of one length"
            )
        log_proposal = torch.full((len(index),), torch.nan, dtype=torch.float64)
        if self._proposal is not None:
            log_proposal = log_density(self._proposal, theta)
            if bool((log_proposal == -torch.inf).any()):
                warn(
                    f"SA305 {int((log_proposal == -torch.inf).sum())} of {len(theta)} "
                    f"rows have density 0 under the proposal {self._label!r}: they "
                    "were not drawn from it",
                    stacklevel=2,
                )
        log_action = self._log_action.double()
        log_action = log_action[index] if log_action.ndim else log_action
        stored = {
            "index": index.to(torch.int64),
            **{
                name: own_tensor(columns[name], torch.float32, name=name)
                for name in ("theta", "action", "x")
            },
            "status": columns["status"].to(torch.int8),
            "log_proposal": log_proposal,
            "log_action": log_action.expand(len(index)),
        }
        self._bank.store(
            {"run": run, "seed": int(seed), "label": self._label},
            {name: c.detach().cpu().numpy() for name, c in stored.items()},
        )

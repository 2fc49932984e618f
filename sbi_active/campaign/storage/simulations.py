"""The simulations of a campaign in banks, one for each form of its simulator."""

from __future__ import annotations

import operator
from collections.abc import Callable
from pathlib import Path
from typing import Any

from sbi_active.campaign.learning.indexed import IndexedSimulator
from sbi_active.simulation.bank.bank import Bank
from sbi_active.simulation.bank.sqlite import NAME
from sbi_active.simulation.model import SimulatorModel
from sbi_active.simulation.workers.store import RowStore


def num_rows(folder: str | None) -> int:
    """Return how many rows of the simulator itself a folder of banks has.

    Args:
        folder: None for none.
    """
    drawn = None if folder is None else Path(folder, "drawn")
    return 0 if drawn is None or not (drawn / NAME).exists() else len(Bank(drawn))


class CampaignBanks:
    """Stores rows of the current simulator and of its noise-free form.

    A row is never simulated twice: what is asked for again, by the same seed, theta and
    action, is read. Rows of rivals, simulators with effects that are compared and not
    used, are not stored.

    Args:
        folder: Of the banks.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._own: Callable[..., Any] | None = None
        self._model = 0
        self._banks: dict[str, Bank] = {}

    def use(self, simulator: Callable[..., Any], model: int) -> None:
        """Store rows of a simulator from now on.

        Args:
            simulator: The current one.
            model: Its number in the campaign.
        """
        self._own, self._model = simulator, model

    def find(self, simulator: Callable[..., Any]) -> RowStore | None:
        """Return the store of a simulator's rows; None where they are not stored."""
        form = self._form(simulator)
        return None if form is None else self.bank(simulator, form)

    def bank(self, simulator: Callable[..., Any], form: str = "drawn") -> Bank:
        """Return the bank of a form of the current simulator, open for writing."""
        name = form if self._model == 0 else f"{form}-model-{self._model}"
        if name not in self._banks:
            self._banks[name] = Bank(self.folder / name, simulator=simulator)
        return self._banks[name]

    def close(self) -> None:
        """Let others write."""
        for bank in self._banks.values():
            bank.close()
        self._banks.clear()

    def _form(self, simulator: Callable[..., Any]) -> str | None:
        own = self._own
        if own is None or simulator is own:
            return None if own is None else "drawn"
        if isinstance(simulator, IndexedSimulator):
            return "by-index" if simulator.simulator is own else None
        if not isinstance(own, SimulatorModel):
            return None
        if not isinstance(simulator, SimulatorModel):
            return None
        if simulator.fn is not own.fn or not _same_effects(simulator, own):
            return None
        if simulator.noise is None and own.noise is not None:
            return "noise-free"
        index = getattr(simulator, "next_index", None)
        return None if index is None else f"drawn-trial-{index}"


def _same_effects(a: Any, b: Any) -> bool:
    mine, yours = (getattr(model, "effects", ()) for model in (a, b))
    return len(mine) == len(yours) and all(map(operator.is_, mine, yours))

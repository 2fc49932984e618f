"""The simulations of a campaign in banks, one for each form of its simulator."""

from __future__ import annotations

import operator
from collections.abc import Callable
from pathlib import Path
from typing import Any

from sbi_active.campaign.learning.indexed import IndexedSimulator
from sbi_active.simulation.bank.bank import Bank
from sbi_active.simulation.bank.sqlite import NAME
from sbi_active.simulation.bank.store import Store
from sbi_active.simulation.model import SimulatorModel
from sbi_active.simulation.workers.store import RowStore

OWN = "drawn"  # rows of the simulator itself


def num_rows(folder: str | None) -> int:
    """Return how many rows of the simulator itself a bank of campaigns has.

    Args:
        folder: Folder of the bank; None for none.
    """
    if folder is None or not Path(folder, NAME).exists():
        return 0
    store = Store(Path(folder))
    return len(Bank(store, name=OWN)) if f"bank {OWN}" in store.kinds() else 0


class CampaignBanks:
    """Stores rows of the current simulator and of its noise-free form.

    A row is never simulated twice: what is asked for again, by the same seed, theta and
    action, is read. Rows of rivals, simulators with effects that are compared and not
    used, are not stored.

    Args:
        place: The file that they are in, or its folder, made when it is needed.
        suffix: Suffix of the banks' names, after another simulator took the place of
            the first.
    """

    def __init__(self, place: Store | Path, suffix: str = "") -> None:
        self._place, self._suffix = place, suffix
        self._own: Callable[..., Any] | None = None
        self._model = 0
        self._banks: dict[str, Bank] = {}

    def use(self, simulator: Callable[..., Any], model: int) -> None:
        """Store rows of a simulator from now on.

        Args:
            simulator: The current one.
            model: Number of the model in the campaign.
        """
        self._own, self._model = simulator, model

    def find(self, simulator: Callable[..., Any]) -> RowStore | None:
        """Return the store of a simulator's rows; None if they are not stored."""
        form = self._form(simulator)
        return None if form is None else self.bank(simulator, form)

    def bank(self, simulator: Callable[..., Any], form: str) -> Bank:
        """Return the bank of a form of the current simulator, open for writing."""
        name = form if self._model == 0 else f"{form}-model-{self._model}"
        name += self._suffix
        if name not in self._banks:
            if isinstance(self._place, Path):
                self._place = Store(self._place, make=True)
            self._banks[name] = Bank(self._place, simulator=simulator, name=name)
        return self._banks[name]

    def close(self) -> None:
        """Let others write."""
        for bank in self._banks.values():
            bank.close()
        self._banks.clear()

    def _form(self, simulator: Callable[..., Any]) -> str | None:
        own = self._own
        if own is None or simulator is own:
            return None if own is None else OWN
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

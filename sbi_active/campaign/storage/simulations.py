"""The storage of a campaign: nothing, its simulations in banks, or all in a folder."""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from torch.distributions import Distribution

from sbi_active.campaign.isolation import guarded, isolated
from sbi_active.campaign.learning.indexed import IndexedSimulator
from sbi_active.campaign.learning.learner import Learner
from sbi_active.campaign.state import CampaignState
from sbi_active.campaign.storage.directory import CampaignDirectory
from sbi_active.simulation.bank.bank import Bank
from sbi_active.simulation.bank.sqlite import NAME
from sbi_active.simulation.bank.store import Store
from sbi_active.simulation.model import SimulatorModel
from sbi_active.simulation.workers.store import metering

OWN = "drawn"  # rows of the simulator itself
Method = TypeVar("Method", bound=Callable[..., Any])


def stored(method: Method) -> Method:
    """Return a method whose simulations are kept, apart from torch's global state.

    See :func:`.isolated`.
    """
    apart = isolated(method)

    @guarded
    @functools.wraps(method)
    def kept(campaign: Any, *arguments: Any, **options: Any) -> Any:
        learner, version = campaign._learner, campaign.state.version.number
        find = campaign._storage.working(learner.simulator, version)
        with metering(campaign.state.meter, find):
            return apart(campaign, *arguments, **options)

    return kept  # type: ignore[return-value]


def num_rows(folder: str | None) -> int:
    """Return how many rows of the simulator itself a bank of campaigns has.

    Args:
        folder: Folder of the bank; None for none.
    """
    if folder is None or not Path(folder, NAME).exists():
        return 0
    store = Store(Path(folder))
    return len(Bank(store, name=OWN)) if f"bank {OWN}" in store.catalog else 0


class Storage:
    """Keeps a campaign in a folder, its simulations in banks, or neither.

    A row is never simulated twice: what is asked for again, by the same seed, theta and
    action, is read. Rows of rivals, simulators with effects that are compared and not
    used, are not stored.

    Args:
        disk: The folder; None keeps the campaign in memory alone.
        bank: Folder of the simulations; None keeps them in the campaign's file.
        prior: Prior that the campaign began with.
    """

    def __init__(
        self,
        disk: CampaignDirectory | None = None,
        bank: str | None = None,
        prior: Distribution | None = None,
    ) -> None:
        self.disk, self.prior = disk, prior
        # The file of the rows, or its folder, where it is made when it is needed.
        self._place = Path(bank) if bank is not None else disk and disk.store
        changes = disk.num_changes if disk is not None and bank is None else 0
        self._suffix = f"-changed-{changes}" if changes else ""
        self._banks: dict[str, Bank] = {}

    @property
    def path(self) -> Path | None:
        """The folder of the campaign."""
        return None if self.disk is None else self.disk.path

    def working(
        self, simulator: Callable[..., Any] | None, version: int
    ) -> Callable[[Callable[..., Any]], Bank | None]:
        """Hold the right to write; return what finds the bank of a simulator.

        Args:
            simulator: The current one.
            version: Number of the version.
        """
        if self.disk is not None:
            self.disk.acquire()

        def find(other: Callable[..., Any]) -> Bank | None:
            form = None
            if self._place is not None and simulator is not None:
                form = _form(other, simulator)
            return form and self._bank(
                other, form + f"-model-{version}" * (version > 0)
            )

        return find

    def _bank(self, simulator: Callable[..., Any], name: str) -> Bank:
        """Return a bank of a form of the current simulator, open for writing."""
        name += self._suffix
        if name not in self._banks:
            if isinstance(self._place, Path):
                self._place = Store(self._place, make=True)
            assert self._place is not None
            self._banks[name] = Bank(self._place, simulator=simulator, name=name)
        return self._banks[name]

    def write(self, event: str, trial: Any = None, **entries: Any) -> None:
        """Write down what happened; it is on the disk when this returns."""
        if self.disk is not None:
            self.disk.write(event, trial, **entries)

    def save(self, state: CampaignState, learner: Learner) -> None:
        """Save what was computed."""
        if self.disk is not None:
            belief = None if learner.belief is learner.prior else learner.belief
            known = {"simulator": learner.simulator, "prior": self.prior}
            self.disk.save(state, belief, known)

    def close(self) -> None:
        """Let others write."""
        for bank in self._banks.values():
            bank.close()
        self._banks.clear()
        if self.disk is not None:
            self.disk.close()


def _form(simulator: Any, own: Any) -> Any:
    """Return the name of a form of the current simulator; None for another one."""
    if simulator is own:
        return OWN
    if isinstance(simulator, IndexedSimulator):
        return "by-index" if simulator.simulator is own else None
    if not (isinstance(simulator, SimulatorModel) and isinstance(own, SimulatorModel)):
        return None
    mine, yours = (getattr(model, "effects", ()) for model in (simulator, own))
    same = len(mine) == len(yours) and all(map(operator.is_, mine, yours))
    if simulator.fn is not own.fn or not same:
        return None
    if simulator.noise is None and own.noise is not None:
        return "noise-free"
    index = getattr(simulator, "next_index", None)
    return None if index is None else f"drawn-trial-{index}"

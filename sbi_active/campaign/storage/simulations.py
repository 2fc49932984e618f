"""Simulations of a campaign in banks: whose rows are kept, and under which name."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from sbi_active.campaign.isolation import guarded, isolated
from sbi_active.campaign.learning.indexed import IndexedSimulator
from sbi_active.expected import require
from sbi_active.simulation.bank.bank import Bank
from sbi_active.simulation.bank.store import NAME, Store
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
        storage, current = campaign._storage, campaign._learner.simulator
        version = campaign.state.version.number
        expected = "the simulator, which is not stored with a campaign"
        advice = "pass it: Campaign.load(directory, simulator=...)"
        require(current is not None, expected, "none", advice)
        storage.acquire()

        def find(simulator: Callable[..., Any]) -> Bank | None:
            return storage.find_bank(form_of(simulator, current), simulator, version)

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


def form_of(simulator: Any, own: Any) -> str | None:
    """Return the name of a form of the current simulator; None for another one.

    Args:
        simulator: Simulator that may be such a form.
        own: The current simulator.
    """
    if simulator is own:
        return OWN
    if isinstance(simulator, IndexedSimulator):
        return "by-index" if simulator.simulator is own else None
    if not (isinstance(simulator, SimulatorModel) and isinstance(own, SimulatorModel)):
        return None
    mine, yours = ([m.fn, *getattr(m, "effects", ())] for m in (simulator, own))
    if [*map(id, mine)] != [*map(id, yours)]:
        return None
    if simulator.noise is None and own.noise is not None:
        return "noise-free"
    index = getattr(simulator, "next_index", None)
    return None if index is None else f"drawn-trial-{index}"

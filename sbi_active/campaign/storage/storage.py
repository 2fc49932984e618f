"""Storage of a campaign: nothing, simulations, or all of it in a folder."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

from torch.distributions import Distribution

from sbi_active.campaign.isolation import guarded, isolated
from sbi_active.campaign.learning.learner import Learner
from sbi_active.campaign.state import CampaignState, Trial
from sbi_active.campaign.storage.directory import CampaignDirectory
from sbi_active.campaign.storage.simulations import CampaignBanks
from sbi_active.simulation.workers.meter import metering
from sbi_active.simulation.workers.store import storing

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
        with (
            metering(campaign.state.meter),
            campaign._storage.working(learner.simulator, version),
        ):
            return apart(campaign, *arguments, **options)

    return kept  # type: ignore[return-value]


class Storage:
    """Keeps a campaign in a folder, its simulations in banks, or neither.

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
        self._banks: CampaignBanks | None = None
        if bank is not None:
            self._banks = CampaignBanks(Path(bank))
        elif disk is not None:
            changes = disk.num_changes
            suffix = f"-changed-{changes}" if changes else ""
            self._banks = CampaignBanks(disk.store, suffix)

    @property
    def path(self) -> Path | None:
        """The folder of the campaign."""
        return None if self.disk is None else self.disk.path

    @contextmanager
    def working(
        self, simulator: Callable[..., Any] | None, version: int
    ) -> Iterator[None]:
        """Hold the right to write, and keep simulations of the current simulator.

        Args:
            simulator: The current one.
            version: Number of the version.
        """
        if self.disk is not None:
            self.disk.acquire()
        if self._banks is None or simulator is None:
            yield
            return
        self._banks.use(simulator, version)
        with storing(self._banks.find):
            yield

    def write(self, event: str, trial: Trial | None = None, **entries: Any) -> None:
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
        if self._banks is not None:
            self._banks.close()
        if self.disk is not None:
            self.disk.close()

"""What can be read of a campaign at any time, without changing anything."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from torch.distributions import Distribution

from sbi_active.actions import ActionSpace
from sbi_active.campaign.checks.health import Health, assess
from sbi_active.campaign.state import CampaignState, Trial
from sbi_active.seeding import derive_seed

if TYPE_CHECKING:
    from sbi_active.criticism import Effect

__all__ = ["CampaignView"]


class CampaignView:
    """The readable half of a :class:`.Campaign`.

    Attributes:
        actions: What the robot may do.
        state: All that happened.
    """

    actions: ActionSpace
    state: CampaignState
    _learner: Any
    _planner: Any

    def __repr__(self) -> str:
        done, pending = len(self.history), self.pending is not None
        return (
            f"Campaign({self.state.method}, {done} trials"
            f"{', one pending' if pending else ''}{self._known_together()})"
        )

    def _known_together(self) -> str:
        """Return what the belief knows of parameters that it does not know alone.

        A belief that was not read from the directory yet is not read for this.
        """
        learner = self._learner
        is_here = self.state.processed and learner._saved is None
        found = getattr(learner.belief if is_here else None, "diagnostics", None)
        return f"; {found.combinations}" if found and found.combinations else ""

    @property
    def belief(self) -> Distribution:
        """The belief after the trials in ``state.processed``; the prior before any.

        A trial that nothing in the prior explains, as after a slip of the unit, is left
        out of it: five times the range of all simulations from the prior beyond them,
        the model's word would be an extrapolation that pushes the belief to an edge.
        ``belief.diagnostics.trustworthy`` is then False and ``warnings`` names
        the trial, until it is told again or withdrawn. Trials that are beyond all
        simulations but nearer stay in the belief and are named as well.
        """
        return self._learner.stated_belief

    @property
    def simulator(self) -> Callable[..., Any]:
        """The current simulator, with the effects that were adopted."""
        return self._learner.simulator

    @simulator.setter
    def simulator(self, simulator: Callable[..., Any]) -> None:
        self._learner.simulator = simulator

    @property
    def prior(self) -> Distribution:
        """The original prior, times those of the effects that were adopted."""
        return self._learner.prior

    @property
    def effects(self) -> Sequence[Effect]:
        """What the simulator may lack, as the campaign was told."""
        return self._planner.effects

    @property
    def health(self) -> Health:
        """Whether the simulator still explains the trials that the belief contains.

        While it is right, an "alarm" comes in at most 5 % of campaigns, however long
        they are, and a "watch" now and then. Under an alarm the belief may be narrow
        and wrong: do :meth:`criticize`.
        """
        return assess(self.state)

    @property
    def history(self) -> Sequence[Trial]:
        """The trials that were told, in order."""
        return tuple(t for t in self.state.trials if t.status != "pending")

    @property
    def pending(self) -> Trial | None:
        """The trial that was asked for and not told yet."""
        waiting = [t for t in self.state.trials if t.status == "pending"]
        return waiting[0] if waiting else None

    @property
    def stop_reason(self) -> str | None:
        """Why ``options.stop`` says to stop, after the trials the belief contains.

        None while the health is not "ok": a confident wrong belief would stop first.
        """
        if self.health != "ok":
            return None
        design = None if self.pending is None else self.pending.design
        return self.state.options.stop.reason(
            self.belief, design, seed=derive_seed(self.state.seed, len(self.history))
        )

"""What a campaign shows, and how it takes what happened: all that computes nothing."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.actions import ActionSpace
from sbi_active.arrays import all_finite, measured
from sbi_active.campaign.health import assess, doubts, in_doubt
from sbi_active.campaign.isolation import guarded
from sbi_active.campaign.state import CampaignState, Trial
from sbi_active.campaign.storage.directory import Storage
from sbi_active.campaign.telling import Facts, Health, Telling, listed
from sbi_active.display.campaign_figure import plot_campaign
from sbi_active.display.campaign_page import campaign_html, to_dataframe
from sbi_active.display.figures import legible
from sbi_active.expected import require
from sbi_active.inference.beliefs.belief import named, names_of, parameter_dim
from sbi_active.inference.rounds.condition import action_rows, outcome_rows
from sbi_active.messages import warn
from sbi_active.seeding import derive_seed

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

    from sbi_active.criticism import Effect


class CampaignTrials(Telling[Trial]):
    """The half of a :class:`.Campaign` that shows and records, and computes nothing.

    Attributes:
        actions: Actions that the robot may take.
        state: State of the campaign.
    """

    actions: ActionSpace
    state: CampaignState
    _learner: Any
    _planner: Any
    _storage: Storage
    _stated: tuple[Distribution, list[str], Distribution] | None = None

    def __repr__(self) -> str:
        done, pending = len(self.history), self.pending is not None
        return (
            f"Campaign({self.state.method}, {done} trials"
            f"{', one pending' if pending else ''}{self._paid()}"
            f"{self._known_together()})"
        )

    def _repr_html_(self) -> str:
        return campaign_html(self)

    def _paid(self) -> str:
        """Return what is spent, where trials have a cost."""
        spent, budget = self.state.spent, self.state.options.stop.budget
        if not spent and budget is None:
            return ""
        shown = "an unknown cost" if spent is None else f"{spent:.4g}"
        return f", {shown}{'' if budget is None else f' of {budget:.4g}'} spent"

    def _known_together(self) -> str:
        """Return the combinations that the belief knows of parameters not known alone.

        A belief that was not read from the directory yet is not read for this.
        """
        learner = self._learner
        is_here = self.state.processed and learner._saved is None
        found = getattr(learner.belief if is_here else None, "diagnostics", None)
        return f"; {found.combinations}" if found and found.combinations else ""

    @property
    def belief(self) -> Distribution:
        """The belief after the trials in ``state.processed``; the prior before any.

        A trial that nothing in the prior explains, as after an error of the unit, is
        left out of it: at five times the range of all simulations beyond them, the
        model would extrapolate and push the belief to an edge.
        ``belief.diagnostics.trustworthy`` is then False and ``warnings`` names the
        trial, until it is told again or withdrawn. Trials that are beyond all
        simulations but nearer stay in the belief and are named as well.
        """
        state, learner = self.state, self._learner
        belief, texts = learner.belief, doubts(state.measured)
        if state.is_stale:
            texts.append(
                "SA601 trials were told or corrected since: update() computes it again"
            )
        if not texts:
            return belief
        if self._stated is None or self._stated[:2] != (belief, texts):
            marked = named(in_doubt(belief, learner.prior, texts), learner.simulator)
            self._stated = belief, texts, marked
        return self._stated[2]

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
        """Effects that the simulator may lack, as the campaign was told."""
        return self._planner.effects

    @property
    def first_prior(self) -> Distribution:
        """The prior that the campaign began with."""
        prior = self._storage.prior
        return self.prior if prior is None else prior

    @property
    def directory(self) -> Path | None:
        """Folder of the campaign; None if it is kept in memory alone."""
        return self._storage.path

    @property
    def x_shape(self) -> torch.Size:
        """Shape of an outcome."""
        return self._learner.x_shape

    @property
    def events(self) -> Sequence[Mapping[str, Any]]:
        """The lines of the log on the disk so far, without one in memory alone."""
        return (*self._storage.events,)

    @property
    def not_in_belief(self) -> Sequence[int]:
        """Indices of trials that were told and the belief takes no account of yet."""
        state = self.state
        known = () if state.is_stale else state.processed
        return [t.index for t in self.history if t.index not in known]

    @property
    def health(self) -> Health:
        """Whether the simulator still explains the trials that the belief contains.

        While it is right, at most 5 % of campaigns raise an "alarm", however long they
        are, and some a "watch". After an alarm the belief may be narrow and wrong: call
        :meth:`criticize`.
        """
        return assess(self.state)

    @property
    def parameter_names(self) -> list[str]:
        """One a parameter of the current simulator; theta_1, ... where it has none."""
        num = parameter_dim(self.prior)
        names = self._declared("parameter_names")
        if names is None or len(names) != num:
            return names_of(self.belief, num)
        return [*names]

    @property
    def channel_names(self) -> list[str] | None:
        """One an entry of the outcome's last axis, where the simulator names them."""
        names = self._declared("channel_names")
        return None if names is None else [*names]

    def _declared(self, what: str) -> Sequence[str] | None:
        """Return names that the simulator has, or had where it is not given."""
        if self.simulator is None:
            return self._storage.manifest.get(what)
        return getattr(self.simulator, what, None)

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

        None while the health is not "ok", but for a budget that is spent: a confident
        wrong belief would stop first.
        """
        for reason in (self.state.used_up, self._planner.spent_up):
            if reason is not None:
                return reason
        if self.health != "ok":
            return None
        design = None if self.pending is None else self.pending.design
        return self.state.options.stop.reason(
            self.belief, design, seed=derive_seed(self.state.seed, len(self.history))
        )

    def to_dataframe(self) -> DataFrame:
        """Return the trials as a table, a row a trial, a pending one too.

        Columns: status and target; the entries of the action, with their units; the
        numbers of the outcome, or an array "x" where they are more than 16; those of
        :class:`.Trial` by their names there, such as "cost"; "expected_information" of
        the action and "expected_information_error", its standard error, in nats;
        "health" when the trial had been used, missing where it was not; "seconds" and
        "cpu_seconds" over all stages. The index is the trial's. Units stand in
        ``attrs["units"]``.
        """
        return to_dataframe(self)

    def plot(
        self, *, theta_true: Tensor | None = None, num_predicted: int = 64
    ) -> Figure:
        """Draw the campaign so far, in one figure.

        It shows the belief of each parameter by round; the expected information gain of
        actions, as the last map if actions have several entries; each outcome with its
        prediction; and the expected and realized information gain of each trial, in
        another color under a watch or an alarm.

        Args:
            theta_true: The truth where it is known, shape (theta_dim,).
            num_predicted: Simulations of each trial behind the predictions; with 0, or
                without the simulator, the surprise of each trial takes their place.

        Raises:
            ValueError: If ``theta_true`` has more numbers than there are parameters.
        """
        num_predicted = 0 if self.state.meter.limit else num_predicted
        how = {"theta_true": theta_true, "num_predicted": num_predicted}
        return legible(plot_campaign(self, **how))

    tell = guarded(Telling.tell)
    attach = guarded(Telling.attach)
    correct = guarded(Telling.correct)
    withdraw = guarded(Telling.withdraw)

    @property
    def _trials(self) -> Sequence[Trial]:
        return self.state.trials

    def _outcome(self, x: Any) -> Any:
        return listed(outcome_told(x, self.x_shape))

    def _executed(self, action: Any, asked: list[float]) -> list[float]:
        if action is None:
            return asked
        executed = _action_told(action, self.actions.action_dim)
        if not bool(self.actions.contains(executed)):
            warn(
                f"SA202 the executed action {executed.tolist()} is not in "
                f"{self.actions}; it is simulated where it was executed"
            )
        return listed(executed)

    def _refused(self, x: Any, error: ValueError) -> None:
        self._storage.write("refused", x=f"{x!r:.100000}", error=str(error))

    def _record(self, event: str, facts: Facts) -> Trial:
        self._storage.write(event, facts)  # on the disk before it counts
        self.state.record(facts)
        self._charge()
        return self.state.trials[facts.index]

    def _charge(self) -> None:
        """Bring the costs up to date, unless the function is lacking that says them."""
        limits = self._storage.manifest.get("limits", ())
        if self._planner.has_cost or "cost" not in limits:
            self._planner.charge()


def outcome_told(x: Any, x_shape: torch.Size) -> Tensor:
    """Return the outcome that was told, NaN where not measured, shape x_shape.

    Infinite numbers, which no sensor measures, count as not measured.

    Raises:
        ValueError: If there is no outcome, or one of another shape, or what was told
            are no numbers that float32 holds.
    """
    if x is None:
        raise ValueError(
            "expected the outcome x; got None; tell(x), or tell(status=...) with "
            "'invalid' or 'missing' where there is none"
        )
    row = _numbers(x, "x")
    if row.shape != x_shape:
        is_number = row.numel() == x_shape.numel() == 1
        rows = outcome_rows(row.reshape(x_shape) if is_number else row, x_shape)
        expected = f"one outcome of shape {tuple(x_shape)}"
        require(len(rows) == 1, expected, len(rows), "tell one trial at a time")
        row = rows[0]
    infinite = np.isinf(row.numpy())
    if infinite.any():
        warn(
            f"SA201 {infinite.sum()} of {infinite.size} told numbers are infinite and "
            "count as not measured; pass NaN where a sensor gave nothing"
        )
        row[infinite] = torch.nan
    return row


def _action_told(action: Any, action_dim: int) -> Tensor:
    executed = _numbers(action, "the action")
    if executed.shape != (action_dim,):
        executed = action_rows(executed, action_dim, num_rows=1)[0]
    if not all_finite(executed):
        raise ValueError(
            f"expected a finite action of real numbers; got {executed.tolist()}; pass "
            "the action that was executed, or status='missing' where it is unknown"
        )
    return executed


def _numbers(told: Any, name: str) -> Tensor:
    """Return numbers apart from what the caller may still change."""
    is_listed = not isinstance(told, Tensor) and isinstance(told, Sequence | np.ndarray)
    if is_listed and None in np.array(told, dtype=object).ravel().tolist():
        raise ValueError(
            f"expected {name} of real numbers; got {told!r:.80}; pass NaN where a "
            "sensor gave nothing"
        )
    return measured(told, torch.float32, name=name)

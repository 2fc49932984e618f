"""What a campaign shows, and how it takes what happened: all that computes nothing."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.actions import ActionSpace
from sbi_active.campaign.display.figures import plot_campaign
from sbi_active.campaign.display.page import campaign_html, to_dataframe
from sbi_active.campaign.health import Health, assess, calibration_lost
from sbi_active.campaign.isolation import guarded, isolated
from sbi_active.campaign.state import UNSCORED, CampaignState, Status, Trial
from sbi_active.campaign.storage.simulations import Storage
from sbi_active.campaign.telling import find_trial, told_trial
from sbi_active.display.figures import legible
from sbi_active.inference.beliefs.belief import names_of, parameter_dim
from sbi_active.seeding import derive_seed

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

    from sbi_active.criticism import Effect

Numbers = Tensor | np.ndarray | Sequence[float] | float


class CampaignTrials:
    """The half of a :class:`.Campaign` that shows and records, and computes nothing.

    Attributes:
        actions: Actions that the robot may take.
        state: State of the campaign.
        on_trial: Function that is called with each trial that was told, once it is
            recorded; set it.
        on_update: Function that is called with each trial, once the belief contains it;
            set it.
    """

    actions: ActionSpace
    state: CampaignState
    _learner: Any
    _planner: Any
    _storage: Storage
    on_trial: Callable[[Trial], None] | None = None
    on_update: Callable[[Trial], None] | None = None

    def __repr__(self) -> str:
        done, pending = len(self.history), self.pending is not None
        return (
            f"Campaign({self.state.method}, {done} trials"
            f"{', one pending' if pending else ''}{self._known_together()})"
        )

    def _repr_html_(self) -> str:
        return campaign_html(self)

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
        disk = self._storage.disk
        return () if disk is None else disk.events

    def contains(self, trial: Trial) -> bool:
        """Return whether the belief takes account of a trial as it is recorded now."""
        return trial.index in self.state.processed and not self.state.is_stale

    @property
    def health(self) -> Health:
        """Whether the simulator still explains the trials that the belief contains.

        While it is right, an "alarm" comes in at most 5 % of campaigns, however long
        they are, and a "watch" now and then. Under an alarm the belief may be narrow
        and wrong: do :meth:`criticize`.
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
        disk = self._storage.disk
        if self.simulator is None and disk is not None:
            return disk.manifest[what]
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

        None while the health is not "ok", but for a lost calibration: a confident wrong
        belief would stop first.
        """
        if self.state.used_up is not None:
            return self.state.used_up
        if self.state.options.stop.calibration_lost:
            key = (*self.state.processed, self.state.version.number)
            known = self.__dict__.setdefault("_calibrations", {})
            if key not in known:
                known[key] = isolated(calibration_lost)(self)
            if known[key] is not None:
                return known[key]
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
        :class:`.Trial` by their names there; "expected_information" of the action and
        "expected_information_error", its standard error, in nats; "health" when the
        trial had been used, missing where it was not; "seconds" and "cpu_seconds" over
        all stages. The index is the trial's. Units stand in ``attrs["units"]``.
        """
        return to_dataframe(
            self.state,
            self.actions,
            parameter_names=self.parameter_names,
            channel_names=self.channel_names,
        )

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
        figure = plot_campaign(
            self.state,
            None if self.simulator is None else self._learner.at,
            self.prior,
            parameter_names=self.parameter_names,
            theta_true=theta_true,
            num_predicted=0 if self.state.meter.limit else num_predicted,
        )
        return legible(figure)

    @guarded
    @isolated
    def tell(
        self,
        x: Numbers | None = None,
        *,
        trial: Trial | int | None = None,
        action: Numbers | None = None,
        status: Status = "ok",
    ) -> Trial:
        """Record the outcome of a trial and return at once.

        A trial can be told again: with ``trial=``, another outcome takes the place of
        the recorded one, and the next :meth:`update` computes everything again, beliefs
        and scores of the later trials too, as if it had been told at once. Trials
        behind an adoption are then given to the current model anew, and no longer have
        scores under the models before it.

        Args:
            x: The outcome, shape x_shape; NaN throughout makes the trial "invalid", NaN
                in part of it says that these numbers were not observed, which tells
                nothing by itself. Infinite numbers count as NaN, with a warning.
            trial: The trial or its index; None is the pending one, or a new trial
                where none is pending and ``action`` is given.
            action: The executed action where it is not the one asked for.
            status: "ok", "invalid" (it ran and gave no measurement, which tells about
                the parameters) or "missing" (a fault unrelated to them).

        Returns:
            The recorded trial. Telling the same outcome again changes nothing, with
            ``trial=`` or, for the last trial while none is pending, without.

        Raises:
            ValueError: If there is no such trial, shapes do not fit, the action is not
                finite, or what was told are no real numbers that float32 holds.
        """
        told = self._checked(x, trial=trial, action=action, status=status)
        if any(told is earlier for earlier in self.state.trials):
            return told
        again = told.index < len(self.state.trials) and (
            self.state.trials[told.index].status != "pending"
        )
        return self._record("corrected" if again else "told", told)

    @guarded
    def attach(
        self,
        action: Numbers,
        x: Numbers | None = None,
        *,
        status: Status = "ok",
    ) -> Trial:
        """Record a trial that was executed anyhow, such as before the campaign.

        A pending trial stays pending.

        Args:
            action: Executed action, shape (action_dim,).
            x: Outcome, as in :meth:`tell`.
            status: Status of the trial, as in :meth:`tell`.

        Raises:
            ValueError: If :meth:`tell` would refuse the trial.
        """
        new = Trial(len(self.state.trials), torch.empty(0))
        told = self._checked(x, trial=new, action=action, status=status)
        return self._record("attached", told)

    @guarded
    def correct(
        self,
        trial: Trial | int,
        x: Numbers | None = None,
        *,
        action: Numbers | None = None,
        status: Status = "ok",
        reason: str = "",
    ) -> Trial:
        """Replace what was told of a trial; the log keeps what was told before.

        The next :meth:`update` recomputes everything that depends on it, as if this had
        been told at once. :meth:`tell` with ``trial=`` is the same without a reason.

        Args:
            trial: The trial or its index.
            x: Outcome, as in :meth:`tell`; None keeps the outcome where there is one.
            action: Executed action, as in :meth:`tell`.
            status: Status of the trial, as in :meth:`tell`.
            reason: Reason that is kept with the trial.

        Raises:
            ValueError: If :meth:`tell` would refuse the trial, or it was not told yet.
        """
        found = find_trial(self.state, trial)
        if found.status == "pending":
            raise ValueError(
                f"expected a trial that was told; got trial {found.index}, which is "
                "pending; tell(x) first"
            )
        x = found.x if x is None and status == "ok" else x
        told = self._checked(x, trial=found, action=action, status=status)
        return self._record("corrected", replace(told, reason=reason))

    def _checked(self, x: Any, **options: Any) -> Trial:
        """Return the record; what is refused is written down as well."""
        try:
            return told_trial(
                self.state,
                x,
                x_shape=self._learner.x_shape,
                actions=self.actions,
                **options,
            )
        except ValueError as error:
            self._storage.write("refused", x=f"{x!r:.100000}", error=str(error))
            raise

    def _record(self, event: str, trial: Trial) -> Trial:
        self._storage.write(event, trial)  # on the disk before it counts
        self.state.record(trial)
        if self.on_trial is not None and trial.status != "withdrawn":
            self.on_trial(trial)
        return trial

    @guarded
    def withdraw(self, trial: Trial | int, *, reason: str = "") -> Trial:
        """Take a trial out; it stays in the history, with the status "withdrawn".

        The next :meth:`update` recomputes everything without it, as if it had been
        "missing". :meth:`tell` with ``trial=`` brings it back.

        Args:
            trial: The trial or its index, a pending one too.
            reason: Reason that is kept with the trial.

        Returns:
            The recorded trial.

        Raises:
            ValueError: If there is no such trial.
        """
        found = find_trial(self.state, trial)
        changes: dict[str, Any] = {"status": "withdrawn", "reason": reason}
        return self._record("withdrawn", replace(found, **changes, **UNSCORED))

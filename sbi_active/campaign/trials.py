"""Telling, correcting and withdrawing trials."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from torch import Tensor

from sbi_active.campaign.isolation import guarded, isolated
from sbi_active.campaign.state import UNSCORED, Status, Trial
from sbi_active.campaign.telling import find_trial, new_trial, told_trial
from sbi_active.campaign.view import CampaignView


class CampaignTrials(CampaignView):
    """The half of a :class:`.Campaign` that takes what happened, and computes nothing.

    Attributes:
        on_trial: Function that is called with each trial that was told, once it is
            recorded; set it.
        on_update: Function that is called with each trial, once the belief contains it;
            set it.
    """

    on_trial: Callable[[Trial], None] | None = None
    on_update: Callable[[Trial], None] | None = None

    @guarded
    @isolated
    def tell(
        self,
        x: Tensor | np.ndarray | float | Sequence[float] | None = None,
        *,
        trial: Trial | int | None = None,
        action: Tensor | np.ndarray | Sequence[float] | None = None,
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
        action: Tensor | np.ndarray | Sequence[float] | float,
        x: Tensor | np.ndarray | float | Sequence[float] | None = None,
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
        new = new_trial(self.state)
        told = self._checked(x, trial=new, action=action, status=status)
        return self._record("attached", told)

    @guarded
    def correct(
        self,
        trial: Trial | int,
        x: Tensor | np.ndarray | float | Sequence[float] | None = None,
        *,
        action: Tensor | np.ndarray | Sequence[float] | None = None,
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

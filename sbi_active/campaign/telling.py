"""Outcomes of trials: checked, compared and read from the log, as plain numbers.

A campaign tells by these rules, and so does a command that only reads its folder:
nothing here imports torch.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from typing import TYPE_CHECKING, Any, Generic, Literal, TypeVar

from sbi_active.expected import require

if TYPE_CHECKING:
    import numpy as np
    from torch import Tensor

    Numbers = Tensor | np.ndarray | Sequence[float] | float

Kept = TypeVar("Kept")  # what a campaign keeps of a trial
Status = Literal["pending", "ok", "invalid", "missing", "withdrawn"]
Health = Literal["ok", "watch", "alarm"]

#: Records of a campaign's store: what happened, what was computed from it, and what a
#: reader without torch needs of that.
LOG, STATE, SUMMARY = "log", "state", "summary"


@dataclass(frozen=True)
class Facts:
    """A trial as the log has it: what cannot be computed again.

    Attributes:
        index: Position in the campaign, from 0.
        action: The action asked for and, once told, the one executed.
        x: The outcome in lists of the simulator's shape, None for a number that was not
            measured; None if there is no outcome.
        status: Status of the trial.
        target: Target of the action.
        reason: Reason for which it was corrected or withdrawn.
    """

    index: int
    action: list[float]
    x: Any = None
    status: Status = "pending"
    target: str | None = None
    reason: str = ""

    @classmethod
    def of(cls, trial: Any) -> Facts:
        """Return the facts of a trial, from its tensors where it has such."""
        names = ("status", "target", "reason")
        same = {name: getattr(trial, name) for name in names}
        return cls(trial.index, listed(trial.action), listed(trial.x), **same)

    @property
    def tells(self) -> tuple[Any, ...]:
        """Status, action and x, compared bit for bit since units may be of any size."""
        return self.status, self.action, self.x


class Telling(Generic[Kept]):
    """The methods by which trials are told; a subclass keeps the trials."""

    @property
    def x_shape(self) -> Sequence[int]:
        """Shape of an outcome."""
        raise NotImplementedError

    @property
    def _trials(self) -> Sequence[Kept]:
        """The trials so far, each with the entries of :class:`Facts`."""
        raise NotImplementedError

    def _outcome(self, x: Any) -> Any:
        """Return an outcome as :class:`Facts` have it, or raise a ValueError."""
        raise NotImplementedError

    def _executed(self, action: Any, asked: list[float]) -> list[float]:
        """Return the executed action, ``asked`` where None was told."""
        raise NotImplementedError

    def _refused(self, x: Any, error: ValueError) -> None:
        """Note what was refused."""
        raise NotImplementedError

    def _record(self, event: str, facts: Facts) -> Kept:
        """Write down what happened, and return the trial."""
        raise NotImplementedError

    def tell(
        self,
        x: Numbers | None = None,
        *,
        trial: Kept | int | None = None,
        action: Numbers | None = None,
        status: Status = "ok",
    ) -> Kept:
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
        before, told = self._told(x, trial, action, status)
        if told is before:
            return self._trials[told.index]
        is_first = before.status == "pending"
        return self._record("told" if is_first else "corrected", told)

    def attach(
        self, action: Numbers, x: Numbers | None = None, *, status: Status = "ok"
    ) -> Kept:
        """Record a trial that was executed anyhow, such as before the campaign.

        A pending trial stays pending.

        Args:
            action: Executed action, shape (action_dim,).
            x: Outcome, as in :meth:`tell`.
            status: Status of the trial, as in :meth:`tell`.

        Raises:
            ValueError: If :meth:`tell` would refuse the trial.
        """
        new = Facts(len(self._trials), [])
        return self._record("attached", self._told(x, new, action, status)[1])

    def correct(
        self,
        trial: Kept | int,
        x: Numbers | None = None,
        *,
        action: Numbers | None = None,
        status: Status = "ok",
        reason: str = "",
    ) -> Kept:
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
        before = self._found(trial)
        require(
            before.status != "pending",
            "a trial that was told",
            f"trial {before.index}, which is pending",
            "tell(x) first",
        )
        told = self._told(x, before, action, status)[1]
        return self._record("corrected", replace(told, reason=reason))

    def withdraw(self, trial: Kept | int, *, reason: str = "") -> Kept:
        """Take a trial out; it stays in the history, with the status "withdrawn".

        The next :meth:`update` recomputes everything without it, as if it had been
        "missing". :meth:`tell` with ``trial=`` brings it back.

        Args:
            trial: The trial or its index, a pending one too.
            reason: Reason that is kept with the trial; without one, a trial that is
                withdrawn already keeps its own.

        Returns:
            The recorded trial.

        Raises:
            ValueError: If there is no such trial.
        """
        found = self._found(trial)
        if found.status == "withdrawn":
            reason = reason or found.reason
        told = replace(found, status="withdrawn", reason=reason)
        return (
            self._trials[found.index]
            if told == found
            else self._record("withdrawn", told)
        )

    def _found(self, trial: Any) -> Facts:
        """Return the facts of a trial, or of an index."""
        try:
            index = operator.index(getattr(trial, "index", trial))
        except TypeError:
            index = -1
        require(
            0 <= index < len(self._trials),
            f"the index of one of {len(self._trials)} trials",
            trial if index < 0 else index,
            "pass the trial that ask() returned",
        )
        return Facts.of(self._trials[index])

    def _told(
        self, x: Any, trial: Any, action: Any, status: Status
    ) -> tuple[Facts, Facts]:
        """Return a trial before and after; the same where nothing is new.

        Facts as ``trial`` are the trial itself, which keeps its outcome.
        """
        before = trial if isinstance(trial, Facts) else None
        try:
            require(
                status in ("ok", "invalid", "missing"),
                "status 'ok', 'invalid' or 'missing'",
                repr(status),
                "choose one of these, or withdraw(trial)",
            )
            outcome = None
            if status == "invalid":  # numbers told along with it are no measurement
                outcome = shaped([None] * math.prod(self.x_shape), self.x_shape)
            elif status == "ok":
                outcome = before.x if x is None and before else None
                outcome = self._outcome(x) if outcome is None else outcome
                if all(value is None for value in flat(outcome)):
                    status = "invalid"
            if before is None:
                is_new = action is not None
                before = self._meant(trial, outcome, status, is_new=is_new)
            executed = self._executed(action, before.action)
        except ValueError as error:
            self._refused(x, error)
            raise
        told = replace(before, action=executed, x=outcome, status=status)
        if before.status != "pending":
            told = before if told.tells == before.tells else replace(told, reason="")
        return before, told

    def _meant(
        self, trial: Any, outcome: Any, status: Status, *, is_new: bool
    ) -> Facts:
        """Return the trial that is meant, a new one where none is pending."""
        if trial is not None:
            return self._found(trial)
        trials: Sequence[Any] = self._trials
        for waiting in trials:
            if waiting.status == "pending":
                return Facts.of(waiting)
        if is_new:
            return Facts(len(self._trials), [])
        if trials:  # the last one, told twice
            last = Facts.of(trials[-1])
            if replace(last, x=outcome, status=status).tells == last.tells:
                return last
        raise ValueError(
            "expected a pending trial; got none; ask first, or give the action "
            "of a trial that was not asked for, or the trial to correct"
        )


def event_of(event: str, trial: Any = None, **entries: Any) -> dict[str, Any]:
    """Return a line of the log, with the time.

    Args:
        event: Event that happened.
        trial: The trial as it is afterwards.
        **entries: JSON data.
    """
    facts = trial if trial is None or isinstance(trial, Facts) else Facts.of(trial)
    told = {} if facts is None else {"trial": {**vars(facts)}}
    return {"time": now(), "event": event, **told, **entries}


def facts_in(entry: Mapping[str, Any]) -> Facts | None:
    """Return the trial that a line of the log has, as it was afterwards."""
    return Facts(**entry["trial"]) if "trial" in entry else None


def now() -> str:
    """Return the time, to the second."""
    return datetime.now(timezone.utc).isoformat(timespec="seconds")


def listed(x: Any) -> Any:
    """Return an action or an outcome as :class:`Facts` have it."""
    if not hasattr(x, "numpy"):
        return x
    numbers = x.numpy()
    is_missing = numbers != numbers
    if is_missing.any():
        numbers = numbers.astype(object)
        numbers[is_missing] = None
    return numbers.tolist()


def flat(value: Any) -> list[Any]:
    """Return the parts of nested lists."""
    if not isinstance(value, list):
        return [value]
    if not (value and isinstance(value[0], list)):  # at once, as of an image
        return [*value]
    return [part for item in value for part in flat(item)]


def shaped(numbers: list[Any], shape: Sequence[int]) -> Any:
    """Return numbers as nested lists of a shape."""
    if len(shape) < 2:
        return numbers if shape else numbers[0]
    size = math.prod(shape[1:])
    rows = [numbers[k : k + size] for k in range(0, len(numbers), size)]
    return [shaped(row, shape[1:]) for row in rows]

"""Inputs over time in a table: beside x in its rows, or in a table of their own."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sbi_active.callers import stack_level
from sbi_active.criticism.data.input_series import FAR, GAP
from sbi_active.messages import warn

Array = NDArray[Any]


@dataclass(frozen=True, kw_only=True)
class InputRows:
    """The rows of a table that hold inputs.

    Attributes:
        names: Names of the inputs, each with its label.
        values: Values of the inputs, shape (n, c), NaN where a cell is empty.
        time: Times in s, shape (n,).
        members: Rows of each trial.
        trials: Names of the trials; one empty name where all share the series.
        place: Function that returns the name of a row in messages.
        source: Name of the table in messages.
    """

    names: dict[str, str]
    values: Array
    time: Array
    members: Sequence[Array]
    trials: Sequence[str]
    place: Callable[[Any], str]
    source: str

    def arguments(self) -> dict[str, Any]:
        """Return the inputs as arguments of ``Trials``.

        Raises:
            ValueError: If a trial has fewer than two values of an input, which has a
                gap, or begins long after another trial.
        """
        has = np.isfinite(self.values)
        found, times = {}, {}
        for j, name in enumerate(self.names):
            rows = [at[has[at, j]] for at in self.members]
            for trial, at in zip(self.trials, rows, strict=True):
                self._require_dense(name, trial, at)
            self._require_one_origin(rows)
            found[name] = [self.values[at, j] for at in rows]
            times[name] = [self.time[at] for at in rows]
        return {
            "inputs": found,
            "input_times": times,
            "input_labels": [*self.names.values()],
        }

    def note_empty(self, measured: Array) -> None:
        """Warn of rows with a measurement in which no input stands.

        Args:
            measured: Mask of the rows that have one, shape (n,), bool.
        """
        lost = np.flatnonzero(measured & ~np.isfinite(self.values).any(1))
        if len(lost):
            warn(
                f"SA209 {len(lost)} rows of {self.source} have a measurement and no "
                f"input, the first in {self.place(lost[0])}; there the input before "
                "holds",
                stacklevel=stack_level(),
            )

    def of(self, trials: Sequence[str]) -> InputRows:
        """Return the rows of some trials, in their order.

        Raises:
            ValueError: If one of them has none.
        """
        place = {name: i for i, name in enumerate(self.trials)}
        if [*place] == [""]:
            place = dict.fromkeys(trials, 0)
        for name in trials:
            if name not in place:
                raise ValueError(
                    f"expected inputs of each trial; got none of trial {name} in "
                    f"{self.source}, whose trials are {', '.join(self.trials)}; add "
                    "its rows, or leave the trial out"
                )
        members = [self.members[place[name]] for name in trials]
        return replace(self, members=members, trials=[*trials])

    def require_covered(self, row: Array, time: Array, place: Any, source: str) -> None:
        """Raise if x was measured long before or after the inputs of its trial.

        Args:
            row: Number of the trial in each row of x, shape (k,).
            time: Times of x in s, shape (k,).
            place: Function that returns the name of a row of x in messages.
            source: Name of the table of x in messages.
        """
        for t, at in enumerate(self.members):
            own = self.time[at]
            first, last = own.min(), own.max()
            slack = max(GAP * float(np.median(np.diff(own))), FAR * (last - first))
            far = (time < first - slack) | (time > last + slack)
            for i in np.flatnonzero((row == t) & far):
                raise ValueError(
                    f"expected x within the time of its inputs, {first:g} to {last:g} "
                    f"s in {self.source}; got x at {time[i]:g} s in {place(i)} of "
                    f"{source}; give both times from one origin, with their units as "
                    "in time_ms, or remove what is beyond"
                )

    def _require_one_origin(self, rows: Sequence[Array]) -> None:
        """Raise if a trial begins after another of its length has ended."""
        earliest = min(self.time[at[0]] for at in rows)
        for at in rows:
            begin, end = self.time[at[0]], self.time[at[-1]]
            if begin - earliest > end - begin:
                raise ValueError(
                    f"expected trials that begin at similar times; got {begin:g} s in "
                    f"{self.place(at[0])} of {self.source} and {earliest:g} s in "
                    "another trial; give the times of each trial, those of x too, from "
                    "its own begin, and all in one unit"
                )

    def _require_dense(self, name: str, trial: str, at: Array) -> None:
        if len(at) < 2:
            of_trial = f" in trial {trial}" if trial else ""
            raise ValueError(
                f"expected two or more values of input {name}{of_trial}; got {len(at)} "
                f"in {self.source}; give what does not vary in time as action_*"
            )
        steps = np.diff(self.time[at])
        for k in np.flatnonzero(steps > GAP * np.median(steps)):
            raise ValueError(
                f"expected inputs without gaps; got no {name} from "
                f"{self.time[at[k]]:g} to {self.time[at[k + 1]]:g} s between "
                f"{self.place(at[k])} and {self.place(at[k + 1])} of {self.source}, "
                f"where the median step is {np.median(steps):g} s; fill in what was "
                "commanded there, or split "
                "the trial"
            )

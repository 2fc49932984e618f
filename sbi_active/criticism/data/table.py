r"""Trials from a table, with one row a trial or one row a sample.

A wide table has columns "action_\*" and "x_\*". A long one has besides them "trial" and
"time", and what does not vary within a trial stands in each of its rows; it may have
"input_\*", which do, and then needs no action. Both may have "start_\*", "role",
"index" and "repeat_of". A unit stands in brackets, as in "x_height[mm]", and numbers
become SI.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sbi_active.arrays import Array
from sbi_active.callers import stack_level
from sbi_active.criticism.data.table_columns import (
    Columns,
    as_list,
    bare,
    find_columns,
)
from sbi_active.criticism.data.table_rows import Rows, read_frame
from sbi_active.messages import ChangedWarning, warn

SHOWN = 5  # places that a message lists


def read_table(
    table: str | Path | pd.DataFrame,
    *,
    columns: Mapping[str, str | Sequence[str]] | None = None,
    units: Mapping[str, str] | None = None,
    inputs: str | Path | pd.DataFrame | None = None,
    source: str = "",
) -> dict[str, Any]:
    """Return the arguments of ``Trials`` that a CSV file or a data frame holds.

    Warns of cells without a number, and of trials whose numbers are so much larger than
    the others' that they may be in another unit.

    Args:
        table: Path of a CSV file, or a data frame.
        columns: Names of columns, as in :func:`.find_columns`.
        units: Units by column, as in :func:`.find_columns`.
        inputs: A table of their inputs at times of their own, with columns "time",
            "input_*", and "trial" unless all trials share them. What is said of
            columns and units holds for it too.
        source: Name of the table in messages; "" takes its path.

    Raises:
        ValueError: If a column is missing or unknown, a cell is no number, an action,
            time or index is empty, what belongs to a trial differs within it, a sample
            or a trial is there twice, or inputs have gaps or do not cover x. The text
            says where.
    """
    frame, own_name = read_frame(table, "the table")
    source, beside = source or own_name, None
    if inputs is not None:
        beside, names = _inputs_beside(inputs, columns or {}, units or {})
        if columns is not None:
            columns = {key: name for key, name in columns.items() if key != "input"}
        own = _names(frame)
        units = {k: u for k, u in (units or {}).items() if k in own or k not in names}
    found = find_columns(
        [*frame.columns],
        columns=columns,
        units=units,
        source=source,
        has_inputs=beside is not None,
    )
    if frame.empty:
        raise ValueError(
            f"expected a header and one row a trial or sample; got 0 rows in {source}; "
            "write, say, action_speed,x_distance"
        )
    if beside is not None and found.input:
        raise ValueError(
            f"expected inputs in one table; got {', '.join(found.input)} in {source} "
            f"and more in {beside.source}; keep one"
        )
    _note_converted(found, source)
    return _TrialRows(frame, found, source).trials(beside)


def _inputs_beside(
    table: str | Path | pd.DataFrame,
    columns: Mapping[str, str | Sequence[str]],
    units: Mapping[str, str],
) -> tuple[Rows, set[str]]:
    """Return the rows of a table of inputs, and the names of its columns."""
    frame, source = read_frame(table, "the table of inputs")
    names, told = _names(frame), None
    if "input" in columns:  # what else is said holds for it where it has such columns
        told = {"trial": (), "time": "time", "input": columns["input"]}
        for key in {"trial", "time"} & {*columns}:
            if names.issuperset(as_list(columns[key])):
                told[key] = columns[key]
    found = find_columns(
        [*frame.columns],
        columns=told,
        units={name: unit for name, unit in units.items() if name in names},
        source=source,
        of_inputs=True,
    )
    return Rows(frame, found, source), names


def _note_converted(found: Columns, source: str) -> None:
    """Warn of numbers that the last version left in their unit."""
    now = [c for c, factor in found.factors.items() if factor != 1 and c != found.time]
    if now:
        warn(
            f"SA703 {', '.join(f'{c} to {found.units[c]}' for c in now)}: columns of "
            f"{source} are now converted: let the simulator give these units",
            ChangedWarning,
            stacklevel=stack_level(),
        )


def _names(frame: pd.DataFrame) -> set[str]:
    """Return the names of columns, with and without what stands in brackets."""
    return {*frame.columns, *map(bare, frame.columns)}


class _TrialRows(Rows):
    """The rows of a table of trials."""

    def trials(self, beside: Rows | None = None) -> dict[str, Any]:
        """Return the arguments of the trials.

        Args:
            beside: Rows of another table in which their inputs stand.
        """
        columns, optional, first = self.columns, self.columns.optional, self.first
        is_long, members, time = columns.time is not None, self.members, self.time
        action = np.empty((len(first), 0))
        if columns.action:
            action = np.stack([self.constant(c) for c in columns.action], 1)
        x = np.stack([self.numbers(c, empty=True) for c in columns.x], 1)
        inputs = {} if beside is None else beside.inputs(self.names)
        if columns.input:
            inputs = self.inputs(self.names)
            filled: Array = np.asarray(np.isfinite(x).any(1))
            given: Array = np.asarray(np.isfinite(self.input_values).any(1))
            self._note_without_input(np.flatnonzero(filled & ~given))
            # Inputs may come more often than x: then a row without x is no sample.
            only = given & ~filled
            members = [at[~only[at]] if filled[at].any() else at for at in members]
        samples = [np.column_stack([time[at], x[at]]) for at in members]
        index = np.arange(len(first), dtype=float)
        if "index" in optional:
            index = self.constant(optional["index"])
        if is_long or "index" not in optional:
            self._require_distinct(action, samples)
        for t in np.flatnonzero(pd.Series(index).duplicated()):
            one = first[np.flatnonzero(index == index[t])[0]]
            raise ValueError(
                f"expected each trial once; got index {index[t]:g} in rows {one + 1} "
                f"and {first[t] + 1} of {self.source}; remove one, or give each its "
                "own index where both were executed"
            )
        found = inputs | {
            "action": action if columns.action else None,
            "x": x,
            "index": index,
            "names": self.names if columns.trial else None,
            "start": {columns.short(c): self.constant(c) for c in columns.start}
            or None,
            "action_labels": [*map(columns.label, columns.action)] or None,
            "channel_labels": [*map(columns.label, columns.x)],
        }
        if is_long:
            found["x"] = [s[:, 1] if len(columns.x) == 1 else s[:, 1:] for s in samples]
            found["sample_times"] = [s[:, 0] for s in samples]
        if "role" in optional:
            words = self.constant(optional["role"], self.words(optional["role"]))
            found["role"] = [self._role(t, word) for t, word in enumerate(words)]
        if "repeat_of" in optional:
            column = optional["repeat_of"]
            self.constant(column, self.words(column))
            repeated = self.numbers(column, empty=True)[first]
            found["repeat_of"] = self._positions(repeated, index)
        self._note_empty(x, np.concatenate(members))
        for j, column in enumerate(columns.action):
            self._note_scales(np.abs(action[:, [j]]), column)
        if columns.time is not None:
            self._note_scales([np.diff(s[:, 0]) for s in samples], columns.time)
            for j, column in enumerate(columns.x, 1):
                self._note_scales([np.abs(s[:, j]) for s in samples], column)
        return found

    def _require_distinct(self, action: Array, samples: list[Array]) -> None:
        """Raise if two trials are the same number for number."""
        is_long, seen = self.columns.time is not None, {}
        what = "trials" if is_long else "rows"
        for t, own in enumerate(samples):
            # Repeated trials without a measurement are alike, and yet two trials.
            has = np.isfinite(own[:, 1:])
            if not (has.any() if is_long else has.all()):
                continue
            one = seen.setdefault(np.append(action[t], own).tobytes(), t)
            if one != t:
                raise ValueError(
                    f"expected each trial once; got the same numbers in {what} "
                    f"{self.names[one]} and {self.names[t]} of {self.source}; "
                    "remove one, or give each its own index where both were executed"
                )

    def _role(self, t: int, role: str) -> str:
        if role not in ("", "fit", "held out"):
            raise ValueError(
                "expected a role 'fit' or 'held out' in column "
                f"{self.columns.optional['role']}, {self.place(self.first[t])}; got "
                f"{role!r} in {self.source}; write one of them, or leave it empty "
                "for fit"
            )
        return role or "fit"

    def _positions(self, repeated: Array, index: Array) -> list[int]:
        """Return the position of each repeated trial, -1 for none."""
        place = {value: i for i, value in enumerate(index)}
        for t in np.flatnonzero((repeated >= 0) & ~np.isin(repeated, index)):
            raise ValueError(
                f"expected in repeat_of an index of the table; got {repeated[t]:g} in "
                f"{self.place(self.first[t])} of {self.source}; give that of the "
                "first trial of this action"
            )
        return [place[value] if value >= 0 else -1 for value in repeated]

    def _note_without_input(self, lost: Array) -> None:
        """Warn of rows with a measurement in which no input stands."""
        if len(lost):
            warn(
                f"SA209 {len(lost)} rows of {self.source} have a measurement and no "
                f"input, the first in {self.place(lost[0])}; there the input before "
                "holds",
                stacklevel=stack_level(),
            )

    def _note_empty(self, x: Array, rows: Array) -> None:
        """Warn of what counts as not measured."""
        # Sensors that are read at times of their own leave each other's cells empty.
        others: Any = np.isfinite(x).any(1) & (self.columns.time is not None)
        for column, values in zip(self.columns.x, x.T, strict=True):
            at = np.sort(rows[np.isnan(values[rows]) & ~others[rows]])
            if len(at):
                some = ", ".join(map(self.place, at[:SHOWN]))
                more = f" and {len(at) - SHOWN} more" if len(at) > SHOWN else ""
                warn(
                    f"SA203 {len(at)} of {len(rows)} cells of column {column} in "
                    f"{self.source} hold no number: {some}{more}; they count as not "
                    "measured",
                    stacklevel=stack_level(),
                )

    def _note_scales(
        self,
        sizes: Sequence[Array] | Array,
        column: str,
        *,
        # Decades between the sizes of two groups of trials that look like two units,
        # and those within each.
        gap: float = 1.7,
        within: float = 1.0,
    ) -> None:
        """Warn where some trials' numbers are larger by as much as another unit."""
        middle = [np.nanmedian(s) if np.isfinite(s).any() else 0 for s in sizes]
        some = np.flatnonzero(np.array(middle) > 0)
        if len(some) < 3:
            return
        decades = np.log10(np.array(middle)[some])
        order = np.argsort(decades)
        k = int(np.argmax(np.diff(decades[order]))) + 1
        low, high = decades[order[:k]], decades[order[k:]]
        if high[0] - low[-1] < gap or max(np.ptp(low), np.ptp(high)) > within:
            return
        fewer, word = order[k:], "larger"
        if len(low) < len(high):
            fewer, word = order[:k], "smaller"
        which = ", ".join(self.names[some[i]] for i in sorted(fewer)[:SHOWN])
        factor = 10 ** abs(np.median(high) - np.median(low))
        warn(
            f"SA207 {column} of {'trials' if self.columns.trial else 'rows'} {which} "
            f"in {self.source} is about {factor:.0f} times {word} than that of the "
            "others: check that all are in one unit",
            stacklevel=stack_level(),
        )

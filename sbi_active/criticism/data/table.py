r"""Trials from a table, with one row a trial or one row a sample.

A wide table has columns "action_\*" and "x_\*". A long one has besides them "trial" and
"time", and what does not vary within a trial stands in each of its rows. Both may have
"role", "index" and "repeat_of". A unit stands in brackets, as in "x_height[m]".
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from sbi_active.criticism.data.table_checks import (
    note_empty,
    note_scales,
    require_constant,
    require_distinct,
    require_distinct_trials,
    require_order,
)
from sbi_active.criticism.data.table_columns import Columns, find_columns
from sbi_active.criticism.data.table_rows import Rows, read_csv

__all__ = ["TrialTable", "read_table"]

Array = NDArray[Any]


@dataclass(frozen=True, kw_only=True)
class TrialTable:
    """A table of trials.

    Attributes:
        arguments: Of :class:`.Trials`, by name.
        columns: What its columns are.
        names: What the table calls the trials.
    """

    arguments: dict[str, Any]
    columns: Columns
    names: list[str]

    @property
    def is_long(self) -> bool:
        """Whether it has one row a sample."""
        return self.columns.time is not None


def read_table(
    table: str | Path | pd.DataFrame,
    *,
    columns: Mapping[str, str | Sequence[str]] | None = None,
    units: Mapping[str, str] | None = None,
) -> TrialTable:
    """Read trials from a CSV file or a data frame.

    Warns of cells without a number, and of trials whose numbers are so much larger than
    the others' that they may be in another unit.

    Args:
        table: Path of a CSV file, or a data frame.
        columns: As in :func:`.find_columns`.
        units: As there.

    Raises:
        ValueError: If a column is missing or unknown, a cell is no number, an action,
            time or index is empty, what belongs to a trial differs within it, or a
            sample or a trial is there twice. The text says where.
    """
    source = "the table" if isinstance(table, pd.DataFrame) else str(table)
    frame = table if isinstance(table, pd.DataFrame) else read_csv(Path(table))
    frame = frame.set_axis([str(c).strip() for c in frame.columns], axis=1)
    found = find_columns([*frame.columns], columns=columns, units=units, source=source)
    if frame.empty:
        raise ValueError(
            f"expected a header and one row a trial or sample; got 0 rows in {source}; "
            "do write, say, action_speed,x_distance"
        )
    rows = Rows(frame, found, source)
    return _long(rows) if found.time is not None else _wide(rows)


def _wide(rows: Rows) -> TrialTable:
    columns = rows.columns
    action = rows.numbers(columns.action, empty=False)
    x = rows.numbers(columns.x, empty=True)
    names = [str(i + 1) for i in range(len(x))]
    index = np.arange(len(x), dtype=float)
    if "index" in columns.optional:
        index = rows.numbers([columns.optional["index"]], empty=False)[:, 0]
        require_distinct(index[:, None], "index", rows)
    else:
        require_distinct(np.concatenate([action, x], 1), None, rows)
    note_empty(x, rows)
    for j, column in enumerate(columns.action):
        note_scales(np.abs(action[:, j : j + 1]), names, column, rows)
    found: dict[str, Any] = {"action": action, "x": x, "index": index}
    return _finished(rows, found, names, np.arange(len(x)))


def _long(rows: Rows) -> TrialTable:
    columns, labels = rows.columns, rows.trial
    assert labels is not None
    assert columns.time is not None
    names = [*dict.fromkeys(labels)]
    number = {name: t for t, name in enumerate(names)}
    trial = np.array([number[label] for label in labels])
    time = rows.numbers([columns.time], empty=False)[:, 0] * columns.seconds
    members = [np.flatnonzero(trial == t) for t in range(len(names))]
    require_order(time, members, rows)
    first = np.array([at[0] for at in members])
    action = rows.numbers(columns.action, empty=False)
    for j, column in enumerate(columns.action):
        require_constant(action[:, j], column, members, rows)
    x = rows.numbers(columns.x, empty=True)
    samples = [np.column_stack([time[at], x[at]]) for at in members]
    require_distinct_trials(samples, action[first], names, rows)
    note_empty(x, rows)
    for j, column in enumerate(columns.action):
        note_scales(np.abs(action[first, j : j + 1]), names, column, rows)
    note_scales([np.diff(s[:, 0]) for s in samples], names, columns.time, rows)
    for j, column in enumerate(columns.x):
        note_scales([np.abs(s[:, 1 + j]) for s in samples], names, column, rows)
    found: dict[str, Any] = {
        "action": action[first],
        "x": [s[:, 1] if len(columns.x) == 1 else s[:, 1:] for s in samples],
        "sample_times": [s[:, 0] for s in samples],
        "index": np.arange(len(names), dtype=float),
    }
    if "index" in columns.optional:
        column = columns.optional["index"]
        index = rows.numbers([column], empty=False)[:, 0]
        require_constant(index, column, members, rows)
        found["index"] = index[first]
        require_distinct(found["index"][:, None], "index", rows, first)
    for key in ("role", "repeat_of"):
        if key in columns.optional:
            column = columns.optional[key]
            words = np.array(rows.words(column), dtype=object)
            require_constant(words, column, members, rows)
    return _finished(rows, found, names, first)


def _finished(
    rows: Rows, found: dict[str, Any], names: list[str], first: Array
) -> TrialTable:
    """Return the table with what is optional, from the first row of each trial."""
    columns = rows.columns
    optional = columns.optional
    if "role" in optional:
        words = rows.words(optional["role"])
        found["role"] = [words[i] or "fit" for i in first]
        for i, role in zip(first, found["role"], strict=True):
            if role not in ("fit", "held out"):
                raise ValueError(
                    f"expected a role 'fit' or 'held out' in column "
                    f"{optional['role']}, {rows.place(int(i))}; got {role!r} in "
                    f"{rows.source}; do write one of them, or leave it empty for fit"
                )
    if "repeat_of" in optional:
        repeated = rows.numbers([optional["repeat_of"]], empty=True)[first, 0]
        found["repeat_of"] = _positions(repeated, found["index"], first, rows)
    found["action_labels"] = [columns.label(c) for c in columns.action]
    found["channel_labels"] = [columns.label(c) for c in columns.x]
    return TrialTable(arguments=found, columns=columns, names=names)


def _positions(repeated: Array, index: Array, first: Array, rows: Rows) -> Array:
    """Return the position of each repeated trial, -1 for none."""
    place = {float(value): i for i, value in enumerate(index)}
    found = np.full(len(index), -1.0)
    for i, value in enumerate(repeated):
        if np.isnan(value) or value < 0:
            continue
        if float(value) not in place:
            raise ValueError(
                f"expected in repeat_of an index of the table; got {value:g} in "
                f"{rows.place(int(first[i]))} of {rows.source}; do give that of the "
                "first trial of this action"
            )
        found[i] = place[float(value)]
    return found

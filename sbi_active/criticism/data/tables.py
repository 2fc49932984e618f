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
from sbi_active.criticism.data.columns import (
    TIME,
    TRIAL,
    Column,
    Told,
    Units,
    find_columns,
    pairs,
    require_columns,
    require_named,
)
from sbi_active.criticism.data.files import TABLE, find_recordings, read_csv
from sbi_active.expected import require
from sbi_active.messages import warn

EMPTY = ("", "nan", "none", "na", "<na>", "nat")
ROLES = {"fit": 0.0, "held out": 1.0, "held_out": 1.0}
LARGEST = np.finfo(np.float32).max
#: Roles of columns in a table of inputs beside the trials.
BESIDE = (TRIAL, TIME, "input")
#: Roles of numbers that may be missing.
GAPS = ("x", "input", "repeat_of", "role")
#: What to do about a trial that is there twice.
AGAIN = "remove one, or give each its own index where both were executed"
NONE = np.empty((0, 2))

Source = str | Path | pd.DataFrame


class Table:
    """The rows of a table in SI; where a row is a trial, it is one sample at time 0.

    Args:
        parts: Frames with the same columns, by the files that they stand in.
        columns: Columns of the table.
        source: Name of the table in messages.
        by_file: Whether the names of trials begin with that of their file.

    Attributes:
        frame: Cells by column, and the "time" in s; a row is (file, place, trial).
        names: Names of the trials.
        is_long: Whether a row is a sample.
        is_named: Whether the table names its trials.
    """

    def __init__(
        self,
        parts: Mapping[str, pd.DataFrame],
        columns: Sequence[Column],
        source: str,
        *,
        by_file: bool = False,
    ) -> None:
        self.columns, self.source = columns, source
        numbered = {file: part.reset_index(drop=True) for file, part in parts.items()}
        cells: Any = pd.concat(numbered)
        files, places = zip(*cells.index, strict=True)
        words = {c: _words(cells[c.header]) for c in self.of(TRIAL)}
        labels = [[Path(file).stem for file in files]] * by_file + [*words.values()]
        self.is_long, self.is_named = bool(self.of(TIME)), bool(labels)
        if not labels:  # a row is a trial, or all rows are one series
            num = range(1, len(cells) + 1)
            labels = [[""] * len(num) if self.is_long else [str(row) for row in num]]
        trials = [" ".join(parts) for parts in zip(*labels, strict=True)]
        rows = {"file": files, "place": places, TRIAL: trials}
        cells.index = pd.MultiIndex.from_arrays([*rows.values()], names=[*rows])
        self.frame: Any = pd.DataFrame({TIME: 0.0}, index=cells.index)
        self.names: list[str] = [*cells.index.unique(TRIAL)]
        for column, text in words.items():
            self.require(text != "", column, "the name of a trial", "fill it in", text)
        for column in columns:
            if column.role == TIME:
                self.frame[TIME] = self._times(column, cells[column.header])
            elif column.role != TRIAL:
                self.frame[column] = self._numbers(column, cells[column.header])

    def of(self, role: str) -> list[Column]:
        """Return the columns of a role."""
        return [column for column in self.columns if column.role == role]

    def by_trial(self, rows: Any, columns: Sequence[Any]) -> dict[str, Array]:
        """Return the cells of some rows and columns by the names of their trials."""
        groups = rows[[*columns]].groupby(level=TRIAL, sort=False)
        return {str(name): own.to_numpy() for name, own in groups}

    def _times(self, column: Column, cells: Any) -> Any:
        """Return the time of each row in s, in order within a trial."""
        if cells.dtype.kind in "mM":  # dates are told from the start of each trial
            self.require(cells.notna(), column, "a time", "fill it in", cells)
            start = cells.groupby(level=TRIAL).transform("first")
            time = (cells - start).dt.total_seconds()
        else:
            time = self._numbers(column, cells)
        before = time.groupby(level=TRIAL).shift()
        expected = "times that increase within a trial"
        advice = "sort its rows, remove what is there twice, or name each trial"
        self.require(~(time <= before), column, expected, advice, time, before)
        return time

    def _numbers(self, column: Column, cells: Any) -> Any:
        """Return a column as numbers in SI, NaN where cells may be empty."""
        text, expected = cells.map(lambda cell: str(cell).strip()), "a finite number"
        given = cells if cells.dtype.kind in "biuf" else text
        advice = "write decimals with a point and the unit in the header, as name[unit]"
        if column.role == "role":
            given, expected = text.map(ROLES), "a role 'fit' or 'held out'"
            advice = "write one of them"
        parsed: Any = pd.to_numeric(given, errors="coerce")
        values = parsed.astype(float) * column.factor
        holds, remedy = values.abs() <= LARGEST, "fill it in"
        if column.role in GAPS:
            holds |= text.str.lower().isin(EMPTY)
            remedy = "leave what is unknown empty"
        self.require(holds, column, expected, f"{advice}, and {remedy}", text)
        return values

    def constant(self, column: Column) -> Array:
        """Return the value of each trial in a column, which must not vary within it."""
        values: Any = self.frame[column]
        groups = values.groupby(level=TRIAL, sort=False)
        own = groups.transform("first")
        holds, expected = values.isna() | (values == own), "one value in each trial"
        advice = (
            "call it input_* if it is commanded over time and x_* if it is measured, "
            "give a start_* its value at the start in each row, or give each trial its "
            "own name"
        )
        self.require(holds, column, expected, advice, values, own)
        return groups.first().to_numpy()

    def require(
        self, holds: Any, column: Column, expected: str, advice: str, *cells: Any
    ) -> None:
        """Raise at the first row at which something does not hold.

        Args:
            holds: Whether it holds, shape (n,).
            column: Column of the cells.
            expected: Description of a right cell.
            advice: Advice on what to do.
            *cells: The cells, and those that they come after.
        """
        for i in np.flatnonzero(~np.asarray(holds, dtype=bool))[:1].tolist():
            where = f"{expected} in column {column.header}, {self.place(i)}"
            said = " after ".join(str(own.iloc[i]) or "an empty cell" for own in cells)
            require(False, where, f"{said} in {self.frame.index[i][0]}", advice)

    def place(self, i: int) -> str:
        """Return the number of a row in its file and the name of its trial."""
        _, place, trial = self.frame.index[i]
        return f"row {place + 1}" + f" (trial {trial})" * self.is_named


def _words(cells: Any) -> Any:
    """Return cells as text, "" where they are empty."""
    text: Any = cells.map(lambda cell: str(cell).strip())
    if cells.dtype.kind == "f":  # 1.0 and 1 name one trial
        text = text.str.removesuffix(".0")
    return text.where(~text.str.lower().isin(EMPTY), "")


def read_trials(
    table: Source, columns: Told | None, units: Units | None, inputs: Source | None
) -> dict[str, Any]:
    """Return the arguments of ``Trials`` that a CSV file, folder or data frame holds.

    A folder's trials are those of its ``trials.csv``, or else of all its files
    ``*.csv``, by name with numbers in their order. A file with times and without a
    column "trial" is one trial, named after the file; trials in another file with times
    have its name as a prefix; if a row is a trial, rows are numbered on from file to
    file.

    Warns of cells without a number.

    Args:
        table: Path of a CSV file or of a folder, or a data frame.
        columns: Names of columns, as in :func:`.find_columns`.
        units: Units by column, as in :func:`.find_columns`.
        inputs: A table of their inputs at times of their own, with columns "time",
            "input_*", and "trial" unless all trials share them. What is said of
            columns and units holds for it too.

    Raises:
        ValueError: If a column is missing or unknown, a cell is no number, an action,
            time or index is empty, what belongs to a trial differs within it, a sample
            or a trial is there twice, inputs have gaps or do not cover x, or files of a
            folder have different columns. The text says where.
    """
    own, headers = _read(table, columns, units, "the table")
    beside = None
    if inputs is not None:
        beside, others = _read(inputs, columns, units, "the table of inputs")
        headers += others
        require_columns(beside.columns, [TIME, "input"], beside.source)
        rest = [c.header for c in beside.columns if c.role not in BESIDE]
        rest += [c.header for c in own.of("input")]
        expected = "inputs in one table, and all else in the other"
        require(not rest, expected, ", ".join(rest), "keep each in one of them")
    told = [name for _, name in pairs(columns or {})]
    require_named([*told, *(units or ())], headers, own.source)
    needed = ["x"] if own.of("input") or beside else ["action", "x"]
    if own.is_long or own.is_named or own.of("input"):
        needed = [TIME, *needed] if own.is_named else [TRIAL, TIME, *needed]
    require_columns(own.columns, needed, own.source)
    return arguments_of(own, beside)


def _read(
    table: Any, columns: Told | None, units: Units | None, name: str
) -> tuple[Table, list[str]]:
    """Return a table, and the names of all its columns; ``name`` is a data frame's."""
    parts, source, by_file = {name: table}, name, False
    if not isinstance(table, pd.DataFrame):
        path, source = Path(table), str(table)
        paths = find_recordings(path) if path.is_dir() else [path]
        parts = {str(path): read_csv(path) for path in paths}
        by_file = path.is_dir() and paths[0].name != TABLE
    parts, headers = headed(parts)
    found = find_columns(headers, columns, units, source)
    by_file = by_file and any(column.role == TIME for column in found)
    return Table(parts, found, source, by_file=by_file), headers


def headed(parts: Mapping[str, Any]) -> tuple[dict[str, pd.DataFrame], list[str]]:
    """Return frames whose columns have text as names, and the names.

    Raises:
        ValueError: If they differ from file to file, or a file has no rows.
    """
    named = {
        file: part.set_axis([str(name).strip() for name in part], axis=1)
        for file, part in parts.items()
    }
    first, *_ = named
    headers = [*named[first].columns]
    for file, part in named.items():
        got = f"{', '.join(headers)} in {first} and {', '.join(part)} in {file}"
        same = sorted(part) == sorted(headers)
        require(same, "the same columns in each recording", got, "rename or convert")
        expected = "a header, and one row a trial or sample"
        require(len(part) > 0, expected, f"no rows in {file}", "write them")
    return named, headers


def arguments_of(table: Table, beside: Table | None = None) -> dict[str, Any]:
    """Return the arguments of ``Trials``.

    Args:
        table: Rows of the trials.
        beside: Rows of their inputs at times of their own; None for none.
    """
    samples, columns = _samples(table), table.of("x")
    action = [table.constant(column) for column in table.of("action")]
    index: Any = np.arange(len(table.names), dtype=float)
    for column in table.of("index"):
        index = table.constant(column)
    _require_distinct(table, index)
    x = table.by_trial(samples, columns)
    x = [x[name] for name in table.names]
    times = table.by_trial(samples, [TIME])
    found = {
        "action": np.stack(action, 1) if action else None,
        "x": [own[:, 0] for own in x] if len(columns) == 1 else x,
        "sample_times": [times[name][:, 0] for name in table.names],
        "index": index,
        "names": table.names if table.is_named else None,
        "start": {c.name: table.constant(c) for c in table.of("start")} or None,
        "action_labels": [c.label for c in table.of("action")] or None,
        "channel_labels": [c.label for c in columns],
    }
    if not table.is_long:
        found |= {"x": np.concatenate(x), "sample_times": None}
    if beside is not None or table.of("input"):
        found |= _inputs(beside or table, table.names)
    for column in table.of("role"):
        is_held_out = table.constant(column) == 1
        found["role"] = np.where(is_held_out, "held out", "fit").tolist()
    for column in table.of("repeat_of"):
        told, first = table.frame[column], table.constant(column)
        is_known = told.isna() | (told < 0) | told.isin(index)
        advice, expected = "give that of the first trial", "an index of the table"
        table.require(is_known, column, expected, advice, told)
        place = {value: i for i, value in enumerate(index)}
        found["repeat_of"] = [place.get(value, -1) for value in first]
    return found


def _samples(table: Table) -> Any:
    """Return the rows that are samples, and note empty cells."""
    frame, source, inputs = table.frame, table.source, table.of("input")
    filled = frame[table.of("x")].notna().any(axis=1)
    given = frame[inputs].notna().any(axis=1)
    lost = np.flatnonzero(filled & ~given)
    if inputs and len(lost):
        warn(
            f"SA209 {len(lost)} rows of {source} have a measurement and no input, the "
            f"first in {table.place(lost[0])}; there the input before holds",
        )
    # Inputs may come more often than x: then a row without x is no sample.
    is_sample = filled | ~given | ~filled.groupby(level=TRIAL).transform("any")
    # Sensors that are read at times of their own leave each other's cells empty.
    is_noted = is_sample & ~filled if table.is_long else is_sample
    for column in table.of("x"):
        at = np.flatnonzero(is_noted & frame[column].isna())
        if len(at):
            warn(
                f"SA203 {len(at)} of {is_sample.sum()} cells of column {column.header} "
                f"in {source} hold no number, the first in {table.place(at[0])}; they "
                "count as not measured",
            )
    return frame[is_sample]


def _inputs(table: Table, trials: Sequence[str]) -> dict[str, Any]:
    """Return the inputs of trials, as arguments of ``Trials``.

    Args:
        table: Table in which they stand.
        trials: Names of the trials; all share the one series of a table that names
            none.
    """
    series, times = {}, {}
    for column in table.of("input"):
        known = table.frame[table.frame[column].notna()]
        own = table.by_trial(known, [TIME, column])
        rows = [own.get(name if table.is_named else "", NONE) for name in trials]
        times[column.name] = [each[:, 0] for each in rows]
        series[column.name] = [each[:, 1] for each in rows]
    labels = [column.label for column in table.of("input")]
    return {"inputs": series, "input_times": times, "input_labels": labels}


def _require_distinct(table: Table, index: Array) -> None:
    """Raise if two trials have one index, or are the same number for number."""
    columns, seen = [*table.of("action"), *table.of("input")], dict[Any, str]()
    rows = table.by_trial(table.frame, [TIME, *columns, *table.of("x")])
    x = table.by_trial(table.frame, table.of("x"))
    for place, (name, numbers) in zip(index, rows.items(), strict=True):
        # Repeated trials without a measurement are alike, and yet two trials; so are
        # rows that have an index each.
        has, keys = np.isfinite(x[name]), {place: f"index {place:g}"}
        if has.any() if table.is_long else has.all() and not table.of("index"):
            keys[numbers.tobytes()] = "the same numbers"
        for key, what in keys.items():
            one = seen.setdefault(key, name)
            got = f"{what} in trials {one} and {name} of {table.source}"
            require(one == name, "each trial once", got, AGAIN)

r"""Trials from a table, with one row a trial or one row a sample.

A wide table has columns "action_\*" and "x_\*". A long one has besides them "trial" and
"time", and what does not vary within a trial stands in each of its rows; it may have
"input_\*", which do, and then needs no action. Both may have "start_\*", "role",
"index" and "repeat_of". A unit stands in brackets, as in "x_height[mm]", and numbers
become SI.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sbi_active.arrays import Array
from sbi_active.criticism.data.cells import Cells, read_csv
from sbi_active.criticism.data.columns import (
    TIME,
    TRIAL,
    Told,
    as_list,
    find_columns,
    require_columns,
    split,
)
from sbi_active.expected import require
from sbi_active.messages import warn

#: The one table of a folder, where there is such; others are then not trials.
TABLE = "trials.csv"
#: What to do about a trial that is there twice.
AGAIN = "remove one, or give each its own index where both were executed"
SHOWN = 5  # places that a message lists

Source = str | Path | pd.DataFrame


def read_trials(
    table: Source,
    *,
    columns: Told | None = None,
    units: Mapping[str, str] | None = None,
    inputs: Source | None = None,
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
    beside, known = None, set[str]()
    if inputs is not None:
        beside, known = _inputs_beside(inputs, columns or {}, units or {})
        columns = columns and {k: name for k, name in columns.items() if k != "input"}
    parts, columns = _parts(table, "the table", columns)
    source = str(table) if isinstance(table, str | Path) else "the table"
    headers = headers_of(parts)
    for name in units or ():
        expected = f"units of columns {', '.join(headers)}"
        is_column = name in known | _names(headers)
        require(is_column, expected, f"one of {name}", "correct the name")
    found = find_columns(headers, columns=columns, units=units, source=source)
    own_inputs = ", ".join(column.header for column in found["input"])
    others = f"{own_inputs} in {source} and more beside"
    require(not (own_inputs and beside), "inputs in one table", others, "keep one")
    needed = [TRIAL, TIME] if found[TRIAL] or found[TIME] or own_inputs else []
    needed += [] if own_inputs or beside else ["action"]
    require_columns(found, [*needed, "x"], source)
    for file, frame in parts.items():
        expected = "a header, and one row a trial or sample"
        require(len(frame) > 0, expected, f"no rows in {file}", "write them")
    return arguments_of(Cells(parts, found, source), beside)


def find_recordings(folder: Path) -> list[Path]:
    """Return the tables of a folder.

    Raises:
        ValueError: If there is none.
    """
    if (folder / TABLE).is_file():
        return [folder / TABLE]
    # Copies to other systems leave files of attributes, "._run.csv".
    visible = (p for p in folder.glob("*.csv") if not p.name.startswith("."))
    found = sorted(visible, key=lambda path: _natural(path.name))
    got = f"no {TABLE} and no other *.csv"
    require(bool(found), f"recordings in {folder}", got, "write one, or one a trial")
    return found


def _natural(name: str) -> list[tuple[int, str]]:
    """Return a key by which run_2 comes before run_10."""
    parts = re.split(r"(\d+)", name)
    return [(int(part), "") if part.isdigit() else (-1, part) for part in parts]


def _parts(
    table: Source, name: str, columns: Told | None = None
) -> tuple[dict[str, pd.DataFrame], Told | None]:
    """Return the frames of a table by their files, and which columns are what.

    Files of a folder have the file in their trials' names.
    """
    if not isinstance(table, str | Path):
        headers = [str(c).strip() for c in table.columns]
        return {name: table.set_axis(headers, axis=1)}, columns
    path = Path(table)
    paths = find_recordings(path) if path.is_dir() else [path]
    frames = {str(path): read_csv(path) for path in paths}
    is_long = TIME in (columns or _names(next(iter(frames.values())).columns))
    if not path.is_dir() or paths[0].name == TABLE or not is_long:
        return frames, columns
    told = [TRIAL] if columns is None else as_list(columns.get(TRIAL, ()))
    for file, frame in zip(paths, frames.values(), strict=True):
        parts = [name for name in told if name in frame.columns]
        label: Any = pd.Series(file.stem, index=frame.index)
        for part in parts:
            label = label + " " + frame[part].str.strip()
        frames[str(file)] = frame.drop(columns=parts).assign(**{TRIAL: label})
    return frames, columns and {**columns, TRIAL: TRIAL}


def headers_of(parts: Mapping[str, pd.DataFrame]) -> list[str]:
    """Return the columns of all files, which have to be the same."""
    first, *_ = parts
    own = [*parts[first].columns]
    for file, frame in parts.items():
        got = f"{', '.join(own)} in {first} and {', '.join(frame.columns)} in {file}"
        same = sorted(frame.columns) == sorted(own)
        require(same, "the same columns in each recording", got, "rename or convert")
    return own


def _names(headers: Sequence[str] | pd.Index) -> set[str]:
    """Return the names of columns, with and without what stands in brackets."""
    return {*headers, *(split(header)[0] for header in headers)}


def _inputs_beside(
    table: Source, columns: Told, units: Mapping[str, str]
) -> tuple[Cells, set[str]]:
    """Return the rows of a table of inputs, and the names of its columns."""
    parts, _ = _parts(table, "the table of inputs")
    headers = headers_of(parts)
    source, names = next(iter(parts)), _names(headers)
    told = None
    if "input" in columns:  # what else is said holds for it where it has such columns
        own = {k: columns[k] for k in (TRIAL, TIME) if k in columns}
        own = {k: value for k, value in own.items() if names.issuperset(as_list(value))}
        told = {TIME: TIME, **own, "input": columns["input"]}
    found = find_columns(headers, columns=told, units=units, source=source)
    require_columns(found, [TIME, "input"], source)
    others = [role for role in found if role not in (TRIAL, TIME, "input")]
    got = ", ".join(column.header for role in others for column in found[role])
    expected = f"columns {TRIAL}, {TIME}, input_* in a table of inputs"
    require(not got, expected, f"{got} in {source}", "move it to the table of trials")
    return Cells(parts, found, source), names


def arguments_of(cells: Cells, beside: Cells | None = None) -> dict[str, Any]:
    """Return the arguments of ``Trials``.

    Args:
        cells: Rows of the trials.
        beside: Rows of their inputs at times of their own; None for none.
    """
    columns, index = cells.columns, np.arange(len(cells.first), dtype=float)
    action = np.empty((len(index), 0))
    if columns["action"]:
        action = np.stack([cells.constant(c) for c in columns["action"]], 1)
    for column in columns["index"]:
        index = cells.constant(column)
    x = _columns(cells, "x")
    samples = _samples(cells, x)
    _require_distinct(cells, action, samples, index)
    values = [each[:, 1] if x.shape[1] == 1 else each[:, 1:] for each in samples]
    found = {
        "action": action if columns["action"] else None,
        "x": values if cells.is_long else x,
        "sample_times": [each[:, 0] for each in samples] if cells.is_long else None,
        "index": index,
        "names": cells.names if cells.is_named else None,
        "start": {c.name: cells.constant(c) for c in columns["start"]} or None,
        "action_labels": [c.label for c in columns["action"]] or None,
        "channel_labels": [c.label for c in columns["x"]],
    }
    if beside is not None or columns["input"]:
        found |= _inputs(beside or cells, cells.names)
    for column in columns["role"]:
        roles = cells.words(column)
        is_role = np.isin(roles.astype(str), ("", "fit", "held out", "held_out"))
        advice = "write one of them, or leave it empty for fit"
        cells.require(
            is_role, column, "a role 'fit' or 'held out'", roles.__getitem__, advice
        )
        found["role"] = [role or "fit" for role in cells.constant(column, roles)]
    for column in columns["repeat_of"]:
        cells.constant(column, cells.words(column))
        repeated = cells.numbers(column, empty=True)
        is_known = ~(repeated >= 0) | np.isin(repeated, index)
        advice = "give that of the first trial of this action"
        expected = "an index of the table"
        cells.require(is_known, column, expected, repeated.__getitem__, advice)
        place = {value: i for i, value in enumerate(index)}
        found["repeat_of"] = [place.get(value, -1) for value in repeated[cells.first]]
    return found


def _columns(cells: Cells, role: str) -> Array:
    """Return the numbers of some columns, which may be empty, shape (n, k)."""
    found = [cells.numbers(c, empty=True) for c in cells.columns[role]]
    return np.array(found).reshape(len(found), len(cells.frame)).T


def _samples(cells: Cells, x: Array) -> list[Array]:
    """Return time and numbers of the samples of each trial, and note empty cells.

    Args:
        cells: Rows of the trials.
        x: Numbers of each row, shape (n, k).
    """
    filled: Any = np.isfinite(x).any(1)
    given: Any = np.isfinite(_columns(cells, "input")).any(1)
    members = cells.members
    if cells.columns["input"]:
        if len(lost := np.flatnonzero(filled & ~given)):
            warn(
                f"SA209 {len(lost)} rows of {cells.source} have a measurement and no "
                f"input, the first in {cells.place(lost[0])}; there the input before "
                "holds",
            )
        # Inputs may come more often than x: then a row without x is no sample.
        only = given & ~filled
        members = [at[~only[at]] if filled[at].any() else at for at in members]
    rows = np.sort(np.concatenate(members))
    # Sensors that are read at times of their own leave each other's cells empty.
    rows_lost = rows[~filled[rows]] if cells.is_long else rows
    for column, values in zip(cells.columns["x"], x.T, strict=True):
        at = rows_lost[np.isnan(values[rows_lost])]
        if len(at):
            some = ", ".join(map(cells.place, at[:SHOWN]))
            more = f" and {len(at) - SHOWN} more" if len(at) > SHOWN else ""
            warn(
                f"SA203 {len(at)} of {len(rows)} cells of column {column.header} in "
                f"{cells.source} hold no number: {some}{more}; they count as not "
                "measured",
            )
    return [np.column_stack([cells.time[at], x[at]]) for at in members]


def _inputs(cells: Cells, trials: Sequence[str]) -> dict[str, Any]:
    """Return the inputs of trials, as arguments of ``Trials``.

    Args:
        cells: Rows in which they stand.
        trials: Names of the trials; those without rows share the one series of a table
            that names none.
    """
    place = {name: i for i, name in enumerate(cells.names)}
    if not cells.is_named:
        place = dict.fromkeys(trials, 0)
    for name in trials:
        got = f"none of trial {name} in {cells.source}, whose trials are "
        got += ", ".join(cells.names)
        require(name in place, "inputs of each trial", got, "add its rows")
    series, times = {}, {}
    for column in cells.columns["input"]:
        values = cells.numbers(column, empty=True)
        known = [cells.members[place[name]] for name in trials]
        known = [at[np.isfinite(values[at])] for at in known]
        series[column.name] = [values[at] for at in known]
        times[column.name] = [cells.time[at] for at in known]
    labels = [column.label for column in cells.columns["input"]]
    return {"inputs": series, "input_times": times, "input_labels": labels}


def _require_distinct(
    cells: Cells, action: Array, samples: list[Array], index: Array
) -> None:
    """Raise if two trials have one index, or are the same number for number."""
    inputs, seen = _columns(cells, "input"), dict[object, int]()
    for t, own in enumerate(samples):
        one = seen.setdefault(index[t], t)
        got = f"index {index[t]:g} in trials {cells.names[one]} and {cells.names[t]}"
        require(one == t, "each trial once", f"{got} of {cells.source}", AGAIN)
        # Repeated trials without a measurement are alike, and yet two trials; so are
        # rows that have an index each.
        has = np.isfinite(own[:, 1:])
        is_told = (
            has.any() if cells.is_long else has.all() and not cells.columns["index"]
        )
        told = np.concatenate(
            [action[t], own.ravel(), inputs[cells.members[t]].ravel()]
        )
        one = seen.setdefault(told.tobytes(), t) if is_told else t
        got = f"the same numbers in trials {cells.names[one]} and {cells.names[t]}"
        require(one == t, "each trial once", f"{got} of {cells.source}", AGAIN)

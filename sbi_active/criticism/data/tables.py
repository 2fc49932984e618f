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
    OPTIONAL,
    TRIAL,
    Told,
    as_list,
    find_columns,
    require_columns,
)
from sbi_active.criticism.data.units import TIME, split
from sbi_active.expected import require
from sbi_active.messages import warn

#: The one table of a folder, where there is such; others are then not trials.
TABLE = "trials.csv"
#: What to do about a trial that is there twice.
AGAIN = "remove one, or give each its own index where both were executed"
SHOWN = 5  # places that a message lists


def read_trials(
    table: str | Path | pd.DataFrame,
    *,
    columns: Told | None = None,
    units: Mapping[str, str] | None = None,
    inputs: str | Path | pd.DataFrame | None = None,
) -> dict[str, Any]:
    """Return the arguments of ``Trials`` that a CSV file, folder or data frame holds.

    A folder's trials are those of its ``trials.csv``, or else of all its files
    ``*.csv``, by name with numbers in their order. A file with times and without a
    column "trial" is one trial, named after the file; trials in another file with times
    have its name as a prefix; if a row is a trial, rows are numbered on from file to
    file.

    Warns of cells without a number, and of trials whose numbers are so much larger than
    the others' that they may be in another unit.

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
    parts, columns = _parts(table, "the table", columns)
    source = str(table) if isinstance(table, str | Path) else "the table"
    headers = headers_of(parts)
    known, beside = _names(headers), None
    if inputs is not None:
        beside = _inputs_beside(inputs, columns or {}, units or {})
        known |= _names([*beside.frame.columns])
        columns = columns and {k: name for k, name in columns.items() if k != "input"}
    for name in units or ():
        expected = f"units of columns {', '.join(headers)}"
        require(name in known, expected, f"one of {name}", "correct the name")
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
    table: str | Path | pd.DataFrame, name: str, columns: Told | None = None
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
    is_long = TIME in (columns or map(_bare, next(iter(frames.values())).columns))
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


def _bare(header: str) -> str:
    """Return a column's name without its unit."""
    return split(header)[0]


def _names(headers: Sequence[str]) -> set[str]:
    """Return the names of columns, with and without what stands in brackets."""
    return {*headers, *map(_bare, headers)}


def _inputs_beside(
    table: str | Path | pd.DataFrame, columns: Told, units: Mapping[str, str]
) -> Cells:
    """Return the rows of a table of inputs."""
    parts, _ = _parts(table, "the table of inputs")
    headers = headers_of(parts)
    source, names = next(iter(parts)), _names(headers)
    told = None
    if "input" in columns:  # what else is said holds for it where it has such columns
        also = {
            key: columns[key]
            for key in (TRIAL, TIME)
            if key in columns and names.issuperset(as_list(columns[key]))
        }
        told = {TIME: TIME, **also, "input": columns["input"]}
    found = find_columns(headers, columns=told, units=units, source=source)
    require_columns(found, [TIME, "input"], source)
    for role in ("action", "x", "start", *OPTIONAL):
        expected = f"columns {TRIAL}, {TIME}, input_* in a table of inputs"
        got = f"{role} in {source}"
        require(not found[role], expected, got, "move it to the table of trials")
    return Cells(parts, found, source)


def arguments_of(cells: Cells, beside: Cells | None = None) -> dict[str, Any]:
    """Return the arguments of ``Trials``.

    Args:
        cells: Rows of the trials.
        beside: Rows of their inputs at times of their own; None for none.
    """
    columns, first, names = cells.columns, cells.first, cells.names
    members = cells.members
    action = np.empty((len(first), 0))
    if columns["action"]:
        action = np.stack([cells.constant(c) for c in columns["action"]], 1)
    x = np.stack([cells.numbers(c, empty=True) for c in columns["x"]], 1)
    found = {} if beside is None else _inputs(beside, names)
    if columns["input"]:
        found = _inputs(cells, names)
        filled = np.asarray(np.isfinite(x).any(1))
        values = [cells.numbers(c, empty=True) for c in columns["input"]]
        given = np.asarray(np.isfinite(values).any(0))
        if len(lost := np.flatnonzero(filled & ~given)):
            warn(
                f"SA209 {len(lost)} rows of {cells.source} have a measurement and no "
                f"input, the first in {cells.place(lost[0])}; there the input before "
                "holds",
            )
        # Inputs may come more often than x: then a row without x is no sample.
        only = given & ~filled
        members = [at[~only[at]] if filled[at].any() else at for at in members]
    _note_empty(cells, x, np.concatenate(members))
    samples = [np.column_stack([cells.time[at], x[at]]) for at in members]
    index = np.arange(len(first), dtype=float)
    if columns["index"]:
        index = cells.constant(columns["index"][0])
    if cells.is_long or not columns["index"]:
        _require_distinct(cells, action, samples)
    for t in np.flatnonzero(pd.Series(index).duplicated()):
        one, two = first[np.flatnonzero(index == index[t])[0]], first[t]
        got = f"index {index[t]:g} in rows {one + 1} and {two + 1} of {cells.source}"
        raise ValueError(f"expected each trial once; got {got}; {AGAIN}")
    found |= {
        "action": action if columns["action"] else None,
        "x": x,
        "index": index,
        "names": names if cells.is_named else None,
        "start": {c.name: cells.constant(c) for c in columns["start"]} or None,
        "action_labels": [c.label for c in columns["action"]] or None,
        "channel_labels": [c.label for c in columns["x"]],
    }
    for j, column in enumerate(columns["action"]):
        _note_scales(cells, np.abs(action[:, [j]]), column.header)
    if cells.is_long:
        steps = [np.diff(s[:, 0]) for s in samples]
        _note_scales(cells, steps, columns[TIME][0].header)
        for j, column in enumerate(columns["x"], 1):
            _note_scales(cells, [np.abs(s[:, j]) for s in samples], column.header)
        found["x"] = [s[:, 1] if x.shape[1] == 1 else s[:, 1:] for s in samples]
        found["sample_times"] = [s[:, 0] for s in samples]
    for column in columns["role"]:
        roles = cells.constant(column, cells.words(column))
        for row, role in zip(first, roles, strict=True):
            require(
                role.replace("_", " ") in ("", "fit", "held out"),
                f"a role 'fit' or 'held out' in column {column.header}",
                f"{role!r} in {cells.place(row)} of {cells.file(row)}",
                "write one of them, or leave it empty for fit",
            )
        found["role"] = [role or "fit" for role in roles]
    for column in columns["repeat_of"]:
        cells.constant(column, cells.words(column))
        repeated = cells.numbers(column, empty=True)[first]
        found["repeat_of"] = _positions(cells, repeated, index)
    return found


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


def _require_distinct(cells: Cells, action: Array, samples: list[Array]) -> None:
    """Raise if two trials are the same number for number."""
    seen: dict[bytes, int] = {}
    for t, own in enumerate(samples):
        # Repeated trials without a measurement are alike, and yet two trials.
        has = np.isfinite(own[:, 1:])
        if not (has.any() if cells.is_long else has.all()):
            continue
        at = cells.members[t]
        inputs = [cells.numbers(c, empty=True)[at] for c in cells.columns["input"]]
        told = np.concatenate([action[t], own.ravel(), *inputs])
        one = seen.setdefault(told.tobytes(), t)
        got = f"the same numbers in {'trials' if cells.is_long else 'rows'} "
        got += f"{cells.names[one]} and {cells.names[t]} of {cells.source}"
        require(one == t, "each trial once", got, AGAIN)


def _positions(cells: Cells, repeated: Array, index: Array) -> list[int]:
    """Return the position of each repeated trial, -1 for none."""
    place = {value: i for i, value in enumerate(index)}
    for t in np.flatnonzero((repeated >= 0) & ~np.isin(repeated, index)):
        raise ValueError(
            f"expected in repeat_of an index of the table; got {repeated[t]:g} in "
            f"{cells.place(cells.first[t])} of {cells.source}; give that of the first "
            "trial of this action"
        )
    return [place[value] if value >= 0 else -1 for value in repeated]


def _note_empty(cells: Cells, x: Array, rows: Array) -> None:
    """Warn of what counts as not measured."""
    # Sensors that are read at times of their own leave each other's cells empty.
    others: Any = np.isfinite(x).any(1) & cells.is_long
    for column, values in zip(cells.columns["x"], x.T, strict=True):
        at = np.sort(rows[np.isnan(values[rows]) & ~others[rows]])
        if len(at):
            some = ", ".join(map(cells.place, at[:SHOWN]))
            more = f" and {len(at) - SHOWN} more" if len(at) > SHOWN else ""
            warn(
                f"SA203 {len(at)} of {len(rows)} cells of column {column.header} in "
                f"{cells.source} hold no number: {some}{more}; they count as not "
                "measured",
            )


def _note_scales(
    cells: Cells,
    sizes: Sequence[Array] | Array,
    header: str,
    *,
    # Decades between the sizes of two groups of trials that look like two units, and
    # those within each.
    gap: float = 1.7,
    within: float = 1.0,
) -> None:
    """Warn where some trials' numbers are larger by as much as another unit."""
    middle = [np.nanmedian(s) if np.isfinite(s).any() else 0 for s in sizes]
    known: Any = pd.Series(middle, cells.names)
    decades = known[known > 0].map(np.log10).sort_values(kind="stable")
    if len(decades) < 3:
        return
    k = int(np.argmax(np.diff(decades))) + 1
    low, high = decades[:k], decades[k:]
    if high.min() - low.max() < gap or max(map(np.ptp, (low, high))) > within:
        return
    fewer, word = (low, "smaller") if len(low) < len(high) else (high, "larger")
    which = ", ".join([name for name in cells.names if name in fewer.index][:SHOWN])
    factor = 10 ** (high.median() - low.median())
    warn(
        f"SA207 {header} of {'trials' if cells.is_named else 'rows'} {which} in "
        f"{cells.source} is about {factor:.0f} times {word} than that of the others: "
        "check that all are in one unit",
    )

"""A folder of recordings as one table: a file a trial, or tables of several trials."""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from sbi_active.criticism.data.table import read_table
from sbi_active.criticism.data.table_columns import TRIAL, as_list
from sbi_active.criticism.data.table_rows import read_csv
from sbi_active.criticism.data.units import TIME, split

#: The one table of a folder, where there is such; others are then not trials.
TABLE = "trials.csv"

Told = Mapping[str, str | Sequence[str]]


def read_trials(
    path: str | Path,
    *,
    columns: Told | None = None,
    units: Mapping[str, str] | None = None,
    inputs: str | Path | pd.DataFrame | None = None,
) -> dict[str, Any]:
    """Return the arguments of ``Trials`` that a CSV file or a folder of such holds.

    A folder's trials are those of its ``trials.csv``, or else of all its files
    ``*.csv``, by name with numbers in their order. A file with times and without a
    column "trial" is one trial, named after the file; trials in another file with times
    have its name as a prefix; if a row is a trial, rows are numbered on from file to
    file.

    Args:
        path: Path of the file or folder.
        columns: Columns, as in :func:`.find_columns`.
        units: Units by column, as in :func:`.find_columns`.
        inputs: Table of inputs, as :func:`.read_table` takes it.

    Raises:
        ValueError: If :func:`.read_table` raises it, there is no file in the folder, or
            files have different columns.
    """
    path = Path(path)
    paths = find_recordings(path) if path.is_dir() else [path]
    if paths[0] in (path, path / TABLE):
        return read_table(paths[0], columns=columns, units=units, inputs=inputs)
    frames, told, header = [], columns, None
    for file in paths:
        frame = read_csv(file)
        own = [name for name in frame.columns if name != TRIAL]
        header = header or own
        if sorted(own) != sorted(header):
            raise ValueError(
                f"expected the same columns in each recording; got {', '.join(header)} "
                f"in {paths[0]} and {', '.join(own)} in {file}; rename or convert "
                f"them, or write one table {TABLE} of all trials"
            )
        frame, told = _named(frame, file.stem, columns)
        if inputs is None:  # by itself, so that what is wrong is said with the file
            with warnings.catch_warnings():
                warnings.filterwarnings("ignore", message=".* now converted")  # later
                read_table(frame, columns=told, units=units, source=str(file))
        frames.append(frame)
    joined = pd.concat(frames, ignore_index=True)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".* hold no number")  # said before
        return read_table(
            joined, columns=told, units=units, inputs=inputs, source=str(path)
        )


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
    if not found:
        raise ValueError(
            f"expected recordings in {folder}; got no {TABLE} and no other *.csv; "
            "write one table of all trials, or one a trial"
        )
    return found


def _named(
    frame: pd.DataFrame, file: str, columns: Told | None
) -> tuple[pd.DataFrame, Told | None]:
    """Return the table of a file with the file in its trials' names.

    And which columns are what, where that was told.
    """
    if columns is None:
        names = [split(name)[0] for name in frame.columns]
        is_long, parts = TIME in names, [name for name in [TRIAL] if name in names]
    else:
        told = as_list(columns.get(TRIAL, ()))
        is_long, parts = TIME in columns, [n for n in told if n in frame.columns]
    if not is_long:
        return frame, columns
    name = pd.Series(file, index=frame.index)
    for part in parts:
        name = name + " " + frame[part].astype(str).str.strip()
    frame = frame.drop(columns=parts).assign(**{TRIAL: name})
    return frame, None if columns is None else {**columns, TRIAL: TRIAL}


def _natural(name: str) -> list[tuple[int, str]]:
    """Return a key by which run_2 comes before run_10."""
    parts = re.split(r"(\d+)", name)
    return [(int(part), "") if part.isdigit() else (-1, part) for part in parts]

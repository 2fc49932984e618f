"""Trials from a table with one row a trial."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

__all__ = ["WideTable", "read_wide_table"]

Array = NDArray[Any]

ACTION, OBSERVATION = "action_", "x_"
OPTIONAL = ("role", "index", "repeat_of")


@dataclass(frozen=True, kw_only=True)
class WideTable:
    """A table with one row a trial.

    Attributes:
        arguments: Of :class:`~sbi_active.criticism.Trials`, by name.
        action_names: Columns "action_*" without their beginning.
        channel_names: Columns "x_*" without theirs.
    """

    arguments: dict[str, Any]
    action_names: list[str]
    channel_names: list[str]


def read_wide_table(path: str | Path) -> WideTable:
    r"""Read a CSV file with one row a trial.

    Columns "action_\*" are the action and "x_\*" the observation, in the order of the
    file; an empty cell of these is what was not measured. Optional are "role" ("fit" or
    "held out"), "index" (the place in the order of execution; without it that of the
    row) and "repeat_of" (the index of the trial that is repeated, empty for none).

    Args:
        path: Of the file.

    Raises:
        ValueError: If a column is missing or unknown, a cell is no number, an action or
            index is empty, or a trial is there twice.
    """
    table = _read(path)
    action_columns = [c for c in table if c.startswith(ACTION)]
    x_columns = [c for c in table if c.startswith(OBSERVATION)]
    for name, columns in ((ACTION, action_columns), (OBSERVATION, x_columns)):
        if not columns:
            raise ValueError(
                f"expected columns {name}*; got {', '.join(table)} in {path}; do name "
                "them, as in action_speed, x_distance"
            )
    unknown = [c for c in table if c not in (*action_columns, *x_columns, *OPTIONAL)]
    if unknown:
        raise ValueError(
            f"expected columns {ACTION}*, {OBSERVATION}*, {', '.join(OPTIONAL)}; got "
            f"{', '.join(unknown)} in {path}; do rename or remove what is none of these"
        )
    action = _numbers(table, action_columns, path, empty=False)
    x = _numbers(table, x_columns, path, empty=True)
    found: dict[str, Any] = {"action": action, "x": x}
    index = np.arange(len(table), dtype=float)
    if "index" in table:
        index = _numbers(table, ["index"], path, empty=False)[:, 0]
        found["index"] = index
    _require_distinct(index, action, x, "index" in table, path)
    if "role" in table:
        found["role"] = [str(r).strip() or "fit" for r in table["role"]]
    if "repeat_of" in table:
        repeated = _numbers(table, ["repeat_of"], path, empty=True)[:, 0]
        found["repeat_of"] = _positions(repeated, index, path)
    return WideTable(
        arguments=found,
        action_names=[c[len(ACTION) :] for c in action_columns],
        channel_names=[c[len(OBSERVATION) :] for c in x_columns],
    )


def _read(path: str | Path) -> pd.DataFrame:
    try:
        table = pd.read_csv(path, dtype=str, keep_default_na=False, comment="#")
    except pd.errors.EmptyDataError:
        table = pd.DataFrame()
    except pd.errors.ParserError as error:
        raise ValueError(
            f"expected a CSV file with as many cells in each row as in the first; got "
            f"{error} in {path}; do check the commas"
        ) from error
    table.columns = pd.Index([str(c).strip() for c in table.columns])
    if table.empty:
        raise ValueError(
            f"expected a header and one row a trial; got {len(table)} rows in {path}; "
            "do write, say, action_speed,x_distance"
        )
    return table


def _numbers(
    table: pd.DataFrame, columns: list[str], path: str | Path, *, empty: bool
) -> Array:
    """Return columns as numbers, shape (n, columns), NaN where a cell may be empty."""
    found = np.full((len(table), len(columns)), np.nan)
    for j, column in enumerate(columns):
        for i, cell in enumerate(table[column]):
            text = cell.strip()
            try:
                found[i, j] = float(text) if text else np.nan
            except ValueError as error:
                raise ValueError(
                    f"expected a number in column {column}, row {i + 1}; got {text!r} "
                    f"in {path}; do leave what was not measured empty"
                ) from error
            if not empty and not np.isfinite(found[i, j]):
                raise ValueError(
                    f"expected a finite number in column {column}, row {i + 1}; got "
                    f"{text or 'an empty cell'} in {path}; do fill it in"
                )
    return found


def _require_distinct(
    index: Array, action: Array, x: Array, is_given: bool, path: str | Path
) -> None:
    values = index[:, None] if is_given else np.concatenate([action, x], 1)
    seen: dict[tuple[float, ...], int] = {}
    for i, row in enumerate(values):
        # Repeated trials without any measurement are alike, and yet two trials.
        key = tuple(row) if np.isfinite(row).all() else (*row, i)
        if key in seen:
            what = f"index {row[0]:g}" if is_given else "the same numbers"
            raise ValueError(
                f"expected each trial once; got {what} in rows {seen[key] + 1} and "
                f"{i + 1} of {path}; do remove one, or give each its own index where "
                "both were executed"
            )
        seen[key] = i


def _positions(repeated: Array, index: Array, path: str | Path) -> Array:
    """Return the row of each repeated trial, -1 for none."""
    place = {float(value): i for i, value in enumerate(index)}
    found = np.full(len(index), -1.0)
    for i, value in enumerate(repeated):
        if np.isnan(value) or value < 0:
            continue
        if float(value) not in place:
            raise ValueError(
                f"expected in repeat_of an index of the table; got {value:g} in row "
                f"{i + 1} of {path}; do give that of the first trial of this action"
            )
        found[i] = place[float(value)]
    return found

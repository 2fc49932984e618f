"""Files of trials: a table, or a folder of recordings."""

from __future__ import annotations

import io
import re
from pathlib import Path
from typing import Any

import pandas as pd
from pandas.errors import EmptyDataError, ParserError

from sbi_active.expected import require

#: The one table of a folder, where there is such; others are then not trials.
TABLE = "trials.csv"


def find_recordings(folder: Path) -> list[Path]:
    """Return the tables of a folder, by name with numbers in their order.

    Raises:
        ValueError: If there is none.
    """
    if (folder / TABLE).is_file():
        return [folder / TABLE]
    # Copies to other systems leave files of attributes, "._run.csv".
    visible = (p for p in folder.glob("*.csv") if not p.name.startswith("."))
    found = sorted(visible, key=_natural)
    got = f"no {TABLE} and no other *.csv"
    require(bool(found), f"recordings in {folder}", got, "write one, or one a trial")
    return found


def _natural(path: Path) -> list[int | str]:
    """Return a key by which run_2 comes before run_10."""
    parts = re.split(r"(\d+)", path.name)  # text and numbers in turn
    return [int(part) if k % 2 else part for k, part in enumerate(parts)]


def read_csv(path: Path) -> pd.DataFrame:
    """Return a CSV file as text, its first row as the names of the columns."""
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            # A "#" within a cell is a part of it: only whole lines are comments.
            lines = [line for line in file if not line.lstrip().startswith("#")]
        first = next((line.strip() for line in lines if line.strip()), "")
        advice = "save the table with commas and decimal points, or pass the frame "
        advice += "pandas.read_csv(path, sep=..., decimal=...)"
        holds, got = "," in first or not {*";\t"} & {*first}, f"{first!r} in {path}"
        require(holds, "cells separated by commas", got, advice)
        options: Any = {"header": None, "dtype": str, "keep_default_na": False}
        table = pd.read_csv(io.StringIO("".join(lines)), **options)
    except (UnicodeError, ParserError, EmptyDataError) as error:
        said = str(error).rpartition("error: ")[2].strip()
        raise ValueError(
            "expected text in UTF-8, names of columns, and rows of as many cells; got "
            f"{said!r} in {path}; write decimals with a point, and put text that holds "
            "a comma in quotes"
        ) from error
    return table.iloc[1:].set_axis([*table.iloc[0]], axis=1)

"""The cells of a table of trials, and what messages call its rows."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from sbi_active.criticism.data.table_columns import Columns

__all__ = ["Rows", "read_csv"]

Array = NDArray[Any]

EMPTY = ("", "nan", "none", "na", "<na>")


class Rows:
    """The cells of a table as numbers and words, and what messages call its rows."""

    def __init__(self, frame: pd.DataFrame, columns: Columns, source: str) -> None:
        self.frame, self.columns, self.source = frame, columns, source
        self.trial = None
        if columns.trial:
            parts = [self.words(c) for c in columns.trial]
            for column, part in zip(columns.trial, parts, strict=True):
                for i in np.flatnonzero([not word for word in part]):
                    raise ValueError(
                        f"expected the name of a trial in column {column}, row "
                        f"{i + 1}; got an empty cell in {source}; do fill it in"
                    )
            self.trial = [" ".join(words) for words in zip(*parts, strict=True)]

    def place(self, i: int) -> str:
        """Return what a message calls a row."""
        return f"row {i + 1}" + (
            "" if self.trial is None else f" (trial {self.trial[i]})"
        )

    def words(self, column: str) -> list[str]:
        """Return a column as text, "" where it is empty."""
        cells = self.frame[column]
        if pd.api.types.is_float_dtype(cells):  # 1.0 and 1 name one trial
            text = [f"{value:g}" for value in cells]
        else:
            text = [str(value).strip() for value in cells]
        return ["" if word.lower() in EMPTY else word for word in text]

    def numbers(self, columns: Sequence[str], *, empty: bool) -> Array:
        """Return columns as numbers, shape (n, columns), NaN where cells are empty."""
        found = np.full((len(self.frame), len(columns)), np.nan)
        for j, column in enumerate(columns):
            cells = self.frame[column]
            if pd.api.types.is_numeric_dtype(cells):
                values = cells.to_numpy(dtype=float, na_value=np.nan)
                text = cells
                blank = np.isnan(values)
            else:
                text = cells.astype(str).str.strip()
                blank = text.str.lower().isin(EMPTY).to_numpy()
                values = np.asarray(pd.to_numeric(text, errors="coerce"), dtype=float)
            for i in np.flatnonzero(np.isnan(values) & ~blank):
                raise ValueError(self._no_number(column, int(i), str(text.iloc[i])))
            wrong = ~np.isfinite(values) if not empty else np.isinf(values)
            for i in np.flatnonzero(wrong):
                got = "an empty cell" if blank[i] and not str(text.iloc[i]) else None
                raise ValueError(
                    f"expected a finite number in column {column}, "
                    f"{self.place(int(i))}; got {got or text.iloc[i]} in "
                    f"{self.source}; do "
                    + ("leave what was not measured empty" if empty else "fill it in")
                )
            found[:, j] = values
        return found

    def _no_number(self, column: str, i: int, text: str) -> str:
        advice = "leave what was not measured empty"
        if re.fullmatch(r"[-+]?[\d.]+([eE][-+]?\d+)?\s*[^\d\s,;].*", text):
            advice = (
                f"write the unit once, in the header as {column.split('[')[0]}[unit], "
                "with all numbers in it"
            )
        elif re.fullmatch(r"[-+]?\d+,\d+", text):
            advice = "write decimals with a point"
        return (
            f"expected a number in column {column}, {self.place(i)}; got {text!r} in "
            f"{self.source}; do {advice}"
        )


def read_csv(path: Path) -> pd.DataFrame:
    """Return a CSV file as text, its first row as the names of the columns."""
    if not path.is_file():
        raise FileNotFoundError(
            f"expected a CSV file; got none at {path}; do check the path"
        )
    try:
        table = pd.read_csv(
            path,
            header=None,
            dtype=str,
            keep_default_na=False,
            comment="#",
            encoding="utf-8-sig",
        )
    except pd.errors.EmptyDataError:
        table = pd.DataFrame([[""]])
    except pd.errors.ParserError as error:
        raise ValueError(
            f"expected a CSV file with as many cells in each row as in the first; got "
            f"{error} in {path}; do check the commas"
        ) from error
    header = [str(c).strip() for c in table.iloc[0]]
    if len(header) == 1 and re.search(r"[;\t]", header[0]):
        raise ValueError(
            f"expected cells separated by commas; got {header[0]!r} in {path}; do save "
            "the table with commas"
        )
    return table.iloc[1:].set_axis(header, axis=1).reset_index(drop=True)

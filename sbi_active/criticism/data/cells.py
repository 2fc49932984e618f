"""The cells of a table by trial, and what messages call their places."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from pandas.errors import EmptyDataError, ParserError

from sbi_active.arrays import Array
from sbi_active.criticism.data.columns import TIME, TRIAL, Column
from sbi_active.expected import require

EMPTY = ("", "nan", "none", "na", "<na>", "nat")


class Cells:
    """The rows of a table; where a row is a trial, each is a trial of one sample.

    Args:
        parts: Frames that are a table together, by the files that they stand in.
        columns: Columns of the table, by what they are.
        source: Name of the table in messages.

    Attributes:
        trial: Place of each row's trial, shape (n,).
        names: Names of the trials.
        members: Rows of each trial.
        first: The first row of each.
    """

    def __init__(
        self,
        parts: Mapping[str, pd.DataFrame],
        columns: Mapping[str, Sequence[Column]],
        source: str,
    ) -> None:
        numbered = {file: part.reset_index(drop=True) for file, part in parts.items()}
        whole = pd.concat(numbered)
        self._places = [*whole.index]  # file, and row in it
        self.frame = whole.reset_index(drop=True)
        self.columns, self.source = columns, source
        self.is_long, self.is_named = bool(columns[TIME]), bool(columns[TRIAL])
        # Without names a row is a trial, or all rows are one series.
        numbers = (self.frame.index + 1).astype(str)
        labels = self.frame.index.map(lambda _: "") if self.is_long else numbers
        if self.is_named:
            words = [self.words(column) for column in columns[TRIAL]]
            labels = [" ".join(parts) for parts in zip(*words, strict=True)]
        self.trial, names = pd.factorize(np.array(labels, dtype=object))
        self.names: list[str] = [*names]
        self.members = [np.flatnonzero(self.trial == t) for t in range(len(names))]
        self.first = np.array([at[0] for at in self.members], dtype=int)
        for column in columns[TRIAL]:
            told = self.words(column)
            self.require(
                told != "", column, "the name of a trial", lambda _: "", "fill it in"
            )

    @cached_property
    def time(self) -> Array:
        """Time of each row in s, in order within a trial; 0 without a column of it."""
        if not self.is_long:
            return np.zeros(len(self.frame))
        (column,) = self.columns[TIME]
        cells: Any = self.frame[column.header]
        if cells.dtype.kind in "mM":  # dates are told from the start of each trial
            told = cells.notna().to_numpy()
            self.require(told, column, "a time", lambda i: cells[i], "fill it in")
            start = cells.groupby(self.trial).transform("first")
            time = (cells - start).dt.total_seconds().to_numpy(float)
        else:
            time = self.numbers(column)
        rows = pd.DataFrame({"time": time, "row": [row + 1 for _, row in self._places]})
        before = rows.groupby(self.trial).shift()

        def said(i: int) -> str:
            then, row = before.loc[i]
            return f"{time[i]:g} s after {then:g} s of row {row:.0f}"

        advice = "sort its rows, remove what is there twice, or give each trial its own"
        increases = ~(time <= before["time"].to_numpy())
        expected = "times that increase within a trial"
        self.require(increases, column, expected, said, f"{advice} name")
        return time

    def numbers(self, column: Column, *, empty: bool = False) -> Array:
        """Return a column as numbers in SI, (n,), NaN where cells may be empty."""
        cells: Any = self.frame[column.header]
        text = cells.map(lambda cell: str(cell).strip())
        given = cells if cells.dtype.kind in "biuf" else text
        parsed: Any = pd.to_numeric(given, errors="coerce")
        values = parsed.to_numpy(dtype=float, na_value=np.nan) * column.factor
        is_empty = text.str.lower().isin(EMPTY).to_numpy()
        is_number = np.abs(values) <= np.finfo(np.float32).max
        advice = "write decimals with a point and the unit in the header, as name[unit]"
        advice += (
            ", and leave what was not measured empty" if empty else ", and fill it in"
        )
        holds = is_number | (is_empty & empty)

        def said(i: int) -> str:
            return text[i] if is_empty[i] else repr(text[i])

        self.require(holds, column, "a finite number", said, advice)
        return values

    def words(self, column: Column) -> Array:
        """Return a column as text, shape (n,), "" if it is empty."""
        cells = self.frame[column.header]
        text = cells.map(lambda cell: str(cell).strip())
        if cells.dtype.kind == "f":  # 1.0 and 1 name one trial
            text = text.str.removesuffix(".0")
        return text.where(~text.str.lower().isin(EMPTY), "").to_numpy(dtype=object)

    def constant(self, column: Column, values: Array | None = None) -> Array:
        """Return the value of each trial in a column, which must not vary within it."""
        values = self.numbers(column) if values is None else values
        own = values[self.first]
        self.require(
            values == own[self.trial],
            column,
            "one value in each trial",
            lambda i: f"{values[i]} after {own[self.trial[i]]}",
            "call it input_* if it is commanded over time and x_* if it is measured, "
            "give a start_* its value at the start in each row, or give each trial its "
            "own name",
        )
        return own

    def require(
        self,
        holds: Array,
        column: Column,
        expected: str,
        got: Callable[[int], object],
        advice: str,
    ) -> None:
        """Raise at the first row at which something does not hold.

        Args:
            holds: Whether it holds, shape (n,).
            column: Column of the cells.
            expected: Description of a right cell.
            got: Function that gives a cell in words.
            advice: Advice on what to do.
        """
        for i in np.flatnonzero(~holds)[:1].tolist():
            where = f"{expected} in column {column.header}, {self.place(i)}"
            said = str(got(i)) or "an empty cell"
            require(False, where, f"{said} in {self._places[i][0]}", advice)

    def place(self, i: Any) -> str:
        """Return the number of a row in its file and the name of its trial."""
        name = f" (trial {self.names[self.trial[i]]})" if self.is_named else ""
        return f"row {self._places[i][1] + 1}{name}"


def read_csv(path: Path) -> pd.DataFrame:
    """Return a CSV file as text, its first row as the names of the columns."""
    if not path.is_file():
        raise FileNotFoundError(
            f"expected a CSV file; got none at {path}; check the path"
        )
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            # A "#" within a cell is a part of it: only whole lines are comments.
            lines = [line for line in file if not line.lstrip().startswith("#")]
        first = next((line.strip() for line in lines if line.strip()), "")
        require(
            "," in first or not {*";\t"} & {*first},
            "cells separated by commas",
            f"{first!r} in {path}",
            "save the table with commas and decimal points, or pass the frame "
            "pandas.read_csv(path, sep=..., decimal=...)",
        )
        options: Any = {"header": None, "dtype": str, "keep_default_na": False}
        table = pd.read_csv(io.StringIO("".join(lines)), **options)
    except (UnicodeError, ParserError, EmptyDataError) as error:
        said = str(error).rpartition("error: ")[2].strip()
        raise ValueError(
            "expected text in UTF-8, names of columns, and rows of as many cells; got "
            f"{said!r} in {path}; write decimals with a point, and put text that holds "
            "a comma in quotes"
        ) from error
    header = [str(cell).strip() for cell in table.iloc[0]]
    return table.iloc[1:].set_axis(header, axis=1).reset_index(drop=True)

"""The cells of a table by trial, and what messages call their places."""

from __future__ import annotations

import io
import re
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sbi_active.arrays import Array
from sbi_active.criticism.data.columns import TRIAL, Column
from sbi_active.criticism.data.units import TIME

#: What to do about a column that varies within a trial.
IF_IT_VARIES = (
    "call it input_* if it is commanded over time and x_* if it is measured, give a "
    "start_* its value at the start in each row, or give each trial its own name"
)
EMPTY = ("", "nan", "none", "na", "<na>")


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
        num = len(self.frame)
        # Without names a row is a trial, or all rows are one series.
        labels = [""] * num if self.is_long else [str(i + 1) for i in range(num)]
        if self.is_named:
            words = [self.words(column) for column in columns[TRIAL]]
            labels = [" ".join(parts) for parts in zip(*words, strict=True)]
            for column, each in zip(columns[TRIAL], words, strict=True):
                for i in np.flatnonzero(each == ""):
                    raise ValueError(
                        f"expected the name of a trial in column {column.header}, "
                        f"{self.row(i)}; got an empty cell in {self.file(i)}; fill it "
                        "in"
                    )
        self.trial, names = pd.factorize(np.array(labels, dtype=object))
        self.names: list[str] = [*names]
        self.members = [np.flatnonzero(self.trial == t) for t in range(len(names))]
        self.first = np.array([at[0] for at in self.members], dtype=int)

    @cached_property
    def time(self) -> Array:
        """Time of each row in s, in order within a trial; 0 without a column of it."""
        if not self.is_long:
            return np.zeros(len(self.frame))
        (column,) = self.columns[TIME]
        cells: Any = self.frame[column.header]
        kinds = pd.api.types
        if kinds.is_datetime64_any_dtype(cells) or kinds.is_timedelta64_dtype(cells):
            for i in np.flatnonzero(cells.isna()):
                raise ValueError(
                    f"expected a time in {self.place(i)}; got none in {self.file(i)}; "
                    "fill it in"
                )
            start = cells.iloc[self.first[self.trial]].reset_index(drop=True)
            time = (cells - start).dt.total_seconds().to_numpy(float)
        else:
            time = self.numbers(column)
        for at in self.members:
            for k in np.flatnonzero(np.diff(time[at]) <= 0):
                one, two = at[k], at[k + 1]
                expected, advice = "times that increase within a trial", "sort its rows"
                again = f"{time[two]:g} s in "
                if time[one] == time[two]:
                    expected, advice, again = "each sample once", "remove one", ""
                where = f"{self.place(two)} of {self.file(two)}"
                raise ValueError(
                    f"expected {expected}; got {column.header} = {time[one]:g} s in "
                    f"{self.row(one)} and {again}{where}; {advice}, or give each trial "
                    "its own name"
                )
        return time

    def numbers(self, column: Column, *, empty: bool = False) -> Array:
        """Return a column as numbers in SI, (n,), NaN where cells may be empty."""
        cells: Any = self.frame[column.header]
        text = cells.map(lambda cell: str(cell).strip())
        kinds = pd.api.types
        is_real = kinds.is_numeric_dtype(cells) and not kinds.is_complex_dtype(cells)
        parsed: Any = pd.to_numeric(cells if is_real else text, errors="coerce")
        values = parsed.to_numpy(dtype=float, na_value=np.nan) * column.factor
        is_word = np.isnan(values) & ~text.str.lower().isin(EMPTY).to_numpy()
        wrong = is_word | (np.abs(values) > np.finfo(np.float32).max)
        for i in np.flatnonzero(wrong if empty else wrong | np.isnan(values)):
            got = text.iloc[i] or "an empty cell"
            raise ValueError(
                f"expected a finite number in column {column.header}, {self.place(i)}; "
                f"got {repr(got) if is_word[i] else got} in {self.file(i)}; "
                f"{_remedy(column, got) if is_word[i] else ''}"
                f"{'leave what was not measured empty' if empty else 'fill it in'}"
            )
        return values

    def words(self, column: Column) -> Array:
        """Return a column as text, shape (n,), "" if it is empty."""
        cells = self.frame[column.header]
        text = cells.map(lambda cell: str(cell).strip())
        if pd.api.types.is_float_dtype(cells):  # 1.0 and 1 name one trial
            text = cells.map(_digits)
        return text.where(~text.str.lower().isin(EMPTY), "").to_numpy(dtype=object)

    def constant(self, column: Column, values: Array | None = None) -> Array:
        """Return the value of each trial in a column, which must not vary within it."""
        values = self.numbers(column) if values is None else values
        own = values[self.first]
        for i in np.flatnonzero(values != own[self.trial]):
            one = self.first[self.trial[i]]
            raise ValueError(
                f"expected one value of {column.header} in each trial; got "
                f"{values[one]} in {self.row(one)} and {values[i]} in {self.place(i)} "
                f"of {self.file(i)}; {IF_IT_VARIES}"
            )
        return own

    def row(self, i: Any) -> str:
        """Return the number of a row in its file, in words."""
        return f"row {self._places[i][1] + 1}"

    def place(self, i: Any) -> str:
        """Return the number of a row with the name of its trial, in words."""
        name = f" (trial {self.names[self.trial[i]]})" if self.is_named else ""
        return self.row(i) + name

    def file(self, i: Any) -> str:
        """Return the file in which a row stands."""
        return self._places[i][0]


def _digits(value: float) -> str:
    """Return a number that names a trial, with all its digits; 1.0 and 1 are one."""
    return str(int(value)) if float(value).is_integer() else repr(float(value))


def _remedy(column: Column, text: str) -> str:
    """Return what to do about a cell that is no number."""
    if re.fullmatch(r"[-+]?\d+,\d+", text):
        return "write decimals with a point, and "
    if re.fullmatch(r"[-+]?[\d.]+([eE][-+]?\d+)?\s*[^\d\s,;].*", text):
        name = column.header.split("[")[0]
        return f"write the unit once, in the header as {name}[unit], and "
    return ""


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
        header = next((line.strip() for line in lines if line.strip()), "")
        if (found := re.search(r"[;\t]", header)) and "," not in header:
            options = f"sep={found.group()!r}" + ", decimal=','" * (";" in header)
            raise ValueError(
                f"expected cells separated by commas; got {header!r} in {path}; save "
                "the table with commas and decimal points, or pass "
                f"Trials.from_dataframe(pandas.read_csv(path, {options}))"
            )
        table = pd.read_csv(
            io.StringIO("".join(lines)), header=None, dtype=str, keep_default_na=False
        )
    except UnicodeDecodeError as error:
        raise ValueError(
            f"expected text in UTF-8; got other bytes in {path}; save the table as CSV "
            "in UTF-8"
        ) from error
    except (pd.errors.EmptyDataError, pd.errors.ParserError) as error:
        said = str(error).rpartition("error: ")[2].strip()
        raise ValueError(
            f"expected names of columns, and rows of as many cells; got {said!r} in "
            f"{path}; write decimals with a point, and put text that holds a comma in "
            "quotes"
        ) from error
    header = [str(c).strip() for c in table.iloc[0]]
    return table.iloc[1:].set_axis(header, axis=1).reset_index(drop=True)

"""The cells of a table, by trial, and what messages call their places."""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sbi_active.arrays import Array
from sbi_active.criticism.data.table_columns import PREFIXES, Columns

EMPTY = ("", "nan", "none", "na", "<na>")


def read_frame(table: str | Path | pd.DataFrame, name: str) -> tuple[pd.DataFrame, str]:
    """Return a table with clean names of its columns, and what messages call it."""
    is_frame = isinstance(table, pd.DataFrame)
    frame = table if is_frame else read_csv(Path(table))
    frame = frame.set_axis([str(c).strip() for c in frame.columns], axis=1)
    return frame, name if is_frame else str(table)


class Rows:
    """The rows of a table; where a row is a trial, each is a trial of one sample.

    Args:
        frame: The table.
        columns: Columns of the table, by their role.
        source: Name of the table in messages.

    Attributes:
        code: Number of each row's trial, shape (n,).
        names: Names of the trials.
        members: Rows of each trial.
        first: The first row of each.
    """

    def __init__(self, frame: pd.DataFrame, columns: Columns, source: str) -> None:
        self.frame, self.columns, self.source = frame, columns, source
        parts = [self.words(column) for column in columns.trial]
        for column, part in zip(columns.trial, parts, strict=True):
            for i in np.flatnonzero(part == ""):
                raise ValueError(
                    f"expected the name of a trial in column {column}, row {i + 1}; "
                    f"got an empty cell in {source}; fill it in"
                )
        labels = [" ".join(words) for words in zip(*parts, strict=True)]
        if not columns.trial:
            is_row = columns.time is None  # else all rows are one series
            labels = [str(i + 1) if is_row else "" for i in range(len(frame))]
        self.code, names = pd.factorize(np.array(labels, dtype=object))
        self.names: list[str] = [*names]
        num = len(names)
        self.members = [np.flatnonzero(self.code == t) for t in range(num)]
        self.first = np.array([at[0] for at in self.members])

    @cached_property
    def time(self) -> Array:
        """Return the time of each row in s, in order within a trial; 0 without one."""
        if self.columns.time is None:
            return np.zeros(len(self.frame))
        cells: Any = self.frame[self.columns.time]
        if is_stamp(cells):  # from the start of each trial
            time = np.empty(len(cells))
            for at in self.members:
                time[at] = seconds(cells.iloc[at], self.source)
        else:
            time = self.numbers(self.columns.time)
        self._require_order(time, self.columns.time)
        return time

    @cached_property
    def input_values(self) -> Array:
        """Values of the inputs, shape (n, c), NaN where a cell is empty."""
        return np.stack([self.numbers(c, empty=True) for c in self.columns.input], 1)

    def inputs(self, trials: Sequence[str]) -> dict[str, Any]:
        """Return the inputs of trials, as arguments of ``Trials``.

        Args:
            trials: Names of the trials; those without rows share the one series of a
                table that names none.

        Raises:
            ValueError: If a trial has no rows.
        """
        time, place = self.time, {name: i for i, name in enumerate(self.names)}
        if self.names == [""]:
            place = dict.fromkeys(trials, 0)
        for name in trials:
            if name not in place:
                raise ValueError(
                    f"expected inputs of each trial; got none of trial {name} in "
                    f"{self.source}, whose trials are {', '.join(self.names)}; add "
                    "its rows, or leave the trial out"
                )
        members = [self.members[place[name]] for name in trials]
        series, times, columns = {}, {}, self.columns
        for column, values in zip(columns.input, self.input_values.T, strict=True):
            name, has = columns.short(column), np.isfinite(values)
            series[name] = [values[at[has[at]]] for at in members]
            times[name] = [time[at[has[at]]] for at in members]
        labels = [columns.label(column) for column in columns.input]
        return {"inputs": series, "input_times": times, "input_labels": labels}

    def place(self, i: Any) -> str:
        """Return the name of a row in messages."""
        trial = f" (trial {self.names[self.code[i]]})" if self.columns.trial else ""
        return f"row {i + 1}{trial}"

    def words(self, column: str) -> Array:
        """Return a column as text, shape (n,), "" if it is empty."""
        cells = self.frame[column]
        if pd.api.types.is_float_dtype(cells):  # 1.0 and 1 name one trial
            text = [_digits(value) for value in cells]
        else:
            text = [str(value).strip() for value in cells]
        words = ["" if word.lower() in EMPTY else word for word in text]
        return np.array(words, dtype=object)

    def numbers(self, column: str, *, empty: bool = False) -> Array:
        """Return a column as numbers in SI, (n,), NaN where cells may be empty."""
        cells: Any = self.frame[column]
        require_real(cells, column, self.source)
        text = cells.map(lambda cell: str(cell).strip())
        blank = text.str.lower().isin(EMPTY).to_numpy()
        is_number = pd.api.types.is_numeric_dtype(cells)
        parsed: Any = pd.to_numeric(cells if is_number else text, errors="coerce")
        values = parsed.to_numpy(dtype=float, na_value=np.nan)
        values = values * self.columns.factors.get(column, 1.0)
        leave = "leave what was not measured empty"
        for i in np.flatnonzero(np.isnan(values) & ~blank):
            raise ValueError(
                f"expected a number in column {column}, {self.place(i)}; got "
                f"{text.iloc[i]!r} in {self.source}; "
                + (_remedy(column, text.iloc[i]) or leave)
            )
        too_large = np.abs(values) > np.finfo(np.float32).max  # simulators' numbers
        for i in np.flatnonzero(too_large if empty else too_large | np.isnan(values)):
            raise ValueError(
                f"expected a finite number in column {column}, {self.place(i)}; got "
                f"{text.iloc[i] or 'an empty cell'} in {self.source}; "
                + (leave if empty else "fill it in")
            )
        return values

    def constant(self, column: str, values: Array | None = None) -> Array:
        """Return the value of each trial in a column, which must not vary within it."""
        values = self.numbers(column) if values is None else values
        own = values[self.first]
        for i in np.flatnonzero(values != own[self.code]):
            one = self.first[self.code[i]]
            raise ValueError(
                f"expected one value of {column} in each trial; got {values[one]} in "
                f"row {one + 1} and {values[i]} in {self.place(i)} of {self.source}; "
                f"{_if_it_varies(column)}"
            )
        return own

    def _require_order(self, time: Array, column: str) -> None:
        """Raise if a sample is there twice, or time runs backward in a trial."""
        for at, name in zip(self.members, self.names, strict=True):
            order = at[np.argsort(time[at], kind="stable")]
            for k in np.flatnonzero(np.diff(time[order]) == 0):
                both = f", both of trial {name}" if name else ""
                one, two = sorted(order[k : k + 2] + 1)
                raise ValueError(
                    f"expected each sample once; got {column} = {time[order[k]]:g} s "
                    f"in rows {one} and {two} of {self.source}{both}; "
                    "remove one, or give each trial its own name"
                )
            for k in np.flatnonzero(np.diff(time[at]) < 0):
                raise ValueError(
                    "expected times that increase within a trial; got "
                    f"{time[at[k + 1]]:g} s in {self.place(at[k + 1])} after "
                    f"{time[at[k]]:g} s in row {at[k] + 1} of {self.source}; sort "
                    "its rows, or give each trial its own name"
                )


def is_stamp(cells: pd.Series) -> bool:
    """Return whether a column holds dates or durations."""
    kinds = pd.api.types
    return kinds.is_datetime64_any_dtype(cells) or kinds.is_timedelta64_dtype(cells)


def seconds(cells: pd.Series, source: str) -> Array:
    """Return dates or durations of any unit in seconds since the first, shape (n,).

    Raises:
        ValueError: If one is missing.
    """
    lost = np.flatnonzero(cells.isna())
    if len(lost):
        raise ValueError(
            f"expected a time in row {lost[0] + 1}; got none in {source}; fill it in"
        )
    return (cells - cells.iloc[0]).dt.total_seconds().to_numpy(float)


def require_real(cells: pd.Series, column: str, source: str) -> None:
    """Raise if numbers have an imaginary part, which nothing here could keep."""
    if pd.api.types.is_complex_dtype(cells) or any(
        isinstance(cell, complex) for cell in cells
    ):
        raise ValueError(
            f"expected real numbers in column {column}; got complex ones in {source}; "
            "give the real and the imaginary part a column each"
        )


def _digits(value: float) -> str:
    """Return a number that names a trial, with all its digits; 1.0 and 1 are one."""
    return str(int(value)) if float(value).is_integer() else repr(float(value))


def _if_it_varies(column: str) -> str:
    """Return what to do about a column that varies within a trial."""
    if column.startswith(PREFIXES["action"]):
        name = PREFIXES["input"] + column.removeprefix(PREFIXES["action"])
        return (
            f"call it {name} if it is commanded over time, or give each trial its name"
        )
    if column.startswith(PREFIXES["start"]):
        return "give its value at the start in each row, or call it x_*"
    return (
        "give each trial its own name, x_* to what is measured over time, and input_* "
        "to what is commanded"
    )


def _remedy(column: str, text: str) -> str:
    """Return what to do about a cell that is no number; "" if it says nothing."""
    if re.fullmatch(r"[-+]?[\d.]+([eE][-+]?\d+)?\s*[^\d\s,;].*", text):
        name = f"{column.split('[')[0]}[unit]"
        return f"write the unit once, in the header as {name}, with all numbers in it"
    return "write decimals with a point" if re.fullmatch(r"[-+]?\d+,\d+", text) else ""


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
        _require_commas(lines, path)
        table = pd.read_csv(
            io.StringIO("".join(lines)), header=None, dtype=str, keep_default_na=False
        )
    except UnicodeDecodeError as error:
        raise ValueError(
            f"expected text in UTF-8; got other bytes in {path}; save the table as CSV "
            "in UTF-8"
        ) from error
    except pd.errors.EmptyDataError as error:
        raise ValueError(
            f"expected names of columns and rows; got nothing in {path}; write the "
            "table"
        ) from error
    except pd.errors.ParserError as error:
        raise ValueError(
            f"expected as many cells in each row as in the first{_uneven(str(error))} "
            f"of {path}; write decimals with a point, and put text that holds a comma "
            "in quotes"
        ) from error
    header = [str(c).strip() for c in table.iloc[0]]
    return table.iloc[1:].set_axis(header, axis=1).reset_index(drop=True)


def _require_commas(lines: Sequence[str], path: Path) -> None:
    """Raise if the header's cells are parted by something else."""
    header = next((line.strip() for line in lines if line.strip()), "")
    found = re.search(r"[;\t]", header)
    if found and "," not in header:
        options = f"sep={found.group()!r}" + (", decimal=','" * (found.group() == ";"))
        raise ValueError(
            f"expected cells separated by commas; got {header!r} in {path}; save the "
            "table with commas and decimal points, or pass "
            f"Trials.from_dataframe(pandas.read_csv(path, {options}))"
        )


def _uneven(error: str) -> str:
    """Return what pandas says of a row with another number of cells."""
    told = re.search(r"Expected (\d+) fields in line (\d+), saw (\d+)", error)
    if told is None:
        return f"; got {error.strip()} in a row"
    num, line, got = told.groups()
    return f", {num}; got {got} in line {line}"

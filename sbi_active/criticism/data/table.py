r"""Trials from a table, with one row a trial or one row a sample.

A wide table has columns "action_\*" and "x_\*". A long one has besides them "trial" and
"time", and what does not vary within a trial stands in each of its rows. Both may have
"role", "index" and "repeat_of". A unit stands in brackets, as in "x_height[m]".
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from sbi_active.criticism.data.table_columns import Columns, find_columns

Array = NDArray[Any]

EMPTY = ("", "nan", "none", "na", "<na>")
#: Decades between the sizes of two groups of trials that look like two units, and those
#: within each.
GAP, WITHIN = 1.7, 1.0
SHOWN = 5  # places that a message lists


@dataclass(frozen=True, kw_only=True)
class TrialTable:
    """A table of trials.

    Attributes:
        arguments: Of :class:`.Trials`, by name.
        columns: What its columns are.
    """

    arguments: dict[str, Any]
    columns: Columns


def read_table(
    table: str | Path | pd.DataFrame,
    *,
    columns: Mapping[str, str | Sequence[str]] | None = None,
    units: Mapping[str, str] | None = None,
    source: str = "",
) -> TrialTable:
    """Read trials from a CSV file or a data frame.

    Warns of cells without a number, and of trials whose numbers are so much larger than
    the others' that they may be in another unit.

    Args:
        table: Path of a CSV file, or a data frame.
        columns: As in :func:`.find_columns`.
        units: As there.
        source: What messages call the table; "" takes its path.

    Raises:
        ValueError: If a column is missing or unknown, a cell is no number, an action,
            time or index is empty, what belongs to a trial differs within it, or a
            sample or a trial is there twice. The text says where.
    """
    if not source:
        source = "the table" if isinstance(table, pd.DataFrame) else str(table)
    frame = table if isinstance(table, pd.DataFrame) else read_csv(Path(table))
    frame = frame.set_axis([str(c).strip() for c in frame.columns], axis=1)
    found = find_columns([*frame.columns], columns=columns, units=units, source=source)
    if frame.empty:
        raise ValueError(
            f"expected a header and one row a trial or sample; got 0 rows in {source}; "
            "write, say, action_speed,x_distance"
        )
    return TrialTable(arguments=_Rows(frame, found, source).trials(), columns=found)


class _Rows:
    """The rows of a table; where a row is a trial, each is a trial of one sample."""

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
            labels = [str(i + 1) for i in range(len(frame))]
        self.code, names = pd.factorize(np.array(labels, dtype=object))
        self.names: list[str] = [*names]
        num = len(names)
        self.members = [np.flatnonzero(self.code == t) for t in range(num)]
        self.first = np.array([at[0] for at in self.members])

    def trials(self) -> dict[str, Any]:
        """Return the arguments of the trials."""
        columns, optional, first = self.columns, self.columns.optional, self.first
        time = np.zeros(len(self.frame))
        if columns.time is not None:
            time = self.numbers(columns.time) * columns.seconds
            self._require_order(time, columns.time)
        action = np.stack([self._constant(c) for c in columns.action], 1)
        x = np.stack([self.numbers(c, empty=True) for c in columns.x], 1)
        samples = [np.column_stack([time[at], x[at]]) for at in self.members]
        index = np.arange(len(first), dtype=float)
        if "index" in optional:
            index = self._constant(optional["index"])
        if columns.time is not None or "index" not in optional:
            self._require_distinct(action, samples)
        for t in np.flatnonzero(pd.Series(index).duplicated()):
            one = first[np.flatnonzero(index == index[t])[0]]
            raise ValueError(
                f"expected each trial once; got index {index[t]:g} in rows {one + 1} "
                f"and {first[t] + 1} of {self.source}; remove one, or give each its "
                "own index where both were executed"
            )
        found: dict[str, Any] = {"action": action, "x": x, "index": index}
        if columns.trial:
            found["names"] = self.names
        if columns.time is not None:
            each = [s[:, 1] if len(columns.x) == 1 else s[:, 1:] for s in samples]
            found |= {"x": each, "sample_times": [s[:, 0] for s in samples]}
        if "role" in optional:
            words = self._constant(optional["role"], self.words(optional["role"]))
            found["role"] = [self._role(t, word) for t, word in enumerate(words)]
        if "repeat_of" in optional:
            column = optional["repeat_of"]
            self._constant(column, self.words(column))
            repeated = self.numbers(column, empty=True)[first]
            found["repeat_of"] = self._positions(repeated, index)
        self._note_empty(x)
        for j, column in enumerate(columns.action):
            self._note_scales(np.abs(action[:, [j]]), column)
        if columns.time is not None:
            self._note_scales([np.diff(s[:, 0]) for s in samples], columns.time)
            for j, column in enumerate(columns.x, 1):
                self._note_scales([np.abs(s[:, j]) for s in samples], column)
        found["action_labels"] = [columns.label(c) for c in columns.action]
        found["channel_labels"] = [columns.label(c) for c in columns.x]
        return found

    def place(self, i: Any) -> str:
        """Return what a message calls a row."""
        trial = f" (trial {self.names[self.code[i]]})" if self.columns.trial else ""
        return f"row {i + 1}{trial}"

    def words(self, column: str) -> Array:
        """Return a column as text, shape (n,), "" where it is empty."""
        cells = self.frame[column]
        if pd.api.types.is_float_dtype(cells):  # 1.0 and 1 name one trial
            text = [f"{value:g}" for value in cells]
        else:
            text = [str(value).strip() for value in cells]
        words = ["" if word.lower() in EMPTY else word for word in text]
        return np.array(words, dtype=object)

    def numbers(self, column: str, *, empty: bool = False) -> Array:
        """Return a column as numbers, shape (n,), NaN where cells may be empty."""
        cells = self.frame[column]
        text = cells.map(lambda cell: str(cell).strip())
        blank = text.str.lower().isin(EMPTY).to_numpy()
        is_number = pd.api.types.is_numeric_dtype(cells)
        parsed: Any = pd.to_numeric(cells if is_number else text, errors="coerce")
        values = parsed.to_numpy(dtype=float, na_value=np.nan)
        leave = "leave what was not measured empty"
        for i in np.flatnonzero(np.isnan(values) & ~blank):
            raise ValueError(
                f"expected a number in column {column}, {self.place(i)}; got "
                f"{text.iloc[i]!r} in {self.source}; "
                + (_remedy(column, text.iloc[i]) or leave)
            )
        for i in np.flatnonzero(np.isinf(values) if empty else ~np.isfinite(values)):
            raise ValueError(
                f"expected a finite number in column {column}, {self.place(i)}; got "
                f"{text.iloc[i] or 'an empty cell'} in {self.source}; "
                + (leave if empty else "fill it in")
            )
        return values

    def _constant(self, column: str, values: Array | None = None) -> Array:
        """Return what each trial has in a column, which must not vary within it."""
        values = self.numbers(column) if values is None else values
        own = values[self.first]
        for i in np.flatnonzero(values != own[self.code]):
            one = self.first[self.code[i]]
            raise ValueError(
                f"expected one value of {column} in each trial; got {values[one]} in "
                f"row {one + 1} and {values[i]} in {self.place(i)} of {self.source}; "
                "give each trial its own name, or x_* to what varies"
            )
        return own

    def _require_order(self, time: Array, column: str) -> None:
        """Raise where a sample is there twice, or time runs backward in a trial."""
        for at, name in zip(self.members, self.names, strict=True):
            order = at[np.argsort(time[at], kind="stable")]
            for k in np.flatnonzero(np.diff(time[order]) == 0):
                one, two = sorted(order[k : k + 2] + 1)
                raise ValueError(
                    f"expected each sample once; got {column} = {time[order[k]]:g} s "
                    f"in rows {one} and {two} of {self.source}, both of trial {name}; "
                    "remove one, or give each trial its own name"
                )
            for k in np.flatnonzero(np.diff(time[at]) < 0):
                raise ValueError(
                    "expected times that increase within a trial; got "
                    f"{time[at[k + 1]]:g} s in {self.place(at[k + 1])} after "
                    f"{time[at[k]]:g} s in row {at[k] + 1} of {self.source}; sort "
                    "its rows, or give each trial its own name"
                )

    def _require_distinct(self, action: Array, samples: list[Array]) -> None:
        """Raise where two trials are the same number for number."""
        is_long, seen = self.columns.time is not None, {}
        what = "trials" if is_long else "rows"
        for t, own in enumerate(samples):
            # Repeated trials without a measurement are alike, and yet two trials.
            has = np.isfinite(own[:, 1:])
            if not (has.any() if is_long else has.all()):
                continue
            one = seen.setdefault(np.append(action[t], own).tobytes(), t)
            if one != t:
                raise ValueError(
                    f"expected each trial once; got the same numbers in {what} "
                    f"{self.names[one]} and {self.names[t]} of {self.source}; "
                    "remove one, or give each its own index where both were executed"
                )

    def _role(self, t: int, role: str) -> str:
        if role not in ("", "fit", "held out"):
            raise ValueError(
                "expected a role 'fit' or 'held out' in column "
                f"{self.columns.optional['role']}, {self.place(self.first[t])}; got "
                f"{role!r} in {self.source}; write one of them, or leave it empty "
                "for fit"
            )
        return role or "fit"

    def _positions(self, repeated: Array, index: Array) -> list[int]:
        """Return the position of each repeated trial, -1 for none."""
        place = {value: i for i, value in enumerate(index)}
        for t in np.flatnonzero((repeated >= 0) & ~np.isin(repeated, index)):
            raise ValueError(
                f"expected in repeat_of an index of the table; got {repeated[t]:g} in "
                f"{self.place(self.first[t])} of {self.source}; give that of the "
                "first trial of this action"
            )
        return [place[value] if value >= 0 else -1 for value in repeated]

    def _note_empty(self, x: Array) -> None:
        """Warn of what counts as not measured."""
        for column, values in zip(self.columns.x, x.T, strict=True):
            at = np.flatnonzero(np.isnan(values))
            if len(at):
                some = ", ".join(map(self.place, at[:SHOWN]))
                more = f" and {len(at) - SHOWN} more" if len(at) > SHOWN else ""
                warnings.warn(
                    f"{len(at)} of {len(x)} cells of column {column} in {self.source} "
                    f"hold no number: {some}{more}; they count as not measured",
                    stacklevel=5,
                )

    def _note_scales(self, sizes: Sequence[Array] | Array, column: str) -> None:
        """Warn where some trials' numbers are larger by as much as another unit."""
        middle = [np.nanmedian(s) if np.isfinite(s).any() else 0 for s in sizes]
        some = np.flatnonzero(np.array(middle) > 0)
        if len(some) < 3:
            return
        decades = np.log10(np.array(middle)[some])
        order = np.argsort(decades)
        k = int(np.argmax(np.diff(decades[order]))) + 1
        low, high = decades[order[:k]], decades[order[k:]]
        if high[0] - low[-1] < GAP or max(np.ptp(low), np.ptp(high)) > WITHIN:
            return
        fewer, word = order[k:], "larger"
        if len(low) < len(high):
            fewer, word = order[:k], "smaller"
        which = ", ".join(self.names[some[i]] for i in sorted(fewer)[:SHOWN])
        factor = 10 ** abs(np.median(high) - np.median(low))
        warnings.warn(
            f"{column} of {'trials' if self.columns.trial else 'rows'} {which} in "
            f"{self.source} is about {factor:.0f} times {word} than that of the "
            "others: check that all are in one unit",
            stacklevel=5,
        )


def _remedy(column: str, text: str) -> str:
    """Return what to do about a cell that is no number; "" where it says nothing."""
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
            f"{error} in {path}; check the commas"
        ) from error
    header = [str(c).strip() for c in table.iloc[0]]
    if len(header) == 1 and re.search(r"[;\t]", header[0]):
        raise ValueError(
            f"expected cells separated by commas; got {header[0]!r} in {path}; save "
            "the table with commas"
        )
    return table.iloc[1:].set_axis(header, axis=1).reset_index(drop=True)

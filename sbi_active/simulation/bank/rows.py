"""The rows of a bank in order: found, read by position, and looked at for damage."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sbi_active.simulation.bank.damage import CorruptSegmentError, require
from sbi_active.simulation.bank.segments import (
    COLUMNS,
    Segment,
    find_segment,
    read_columns,
    require_header,
)
from sbi_active.simulation.bank.sqlite import OBJECTS, SEGMENTS
from sbi_active.simulation.bank.store import Store


class Rows:
    """The segments of one bank in a store.

    Args:
        store: The file.
        name: Name of the bank.

    Attributes:
        store: File with the segments.
        name: Name of the bank.
        key: Key of the bank's header.
    """

    def __init__(self, store: Store, name: str) -> None:
        self.store, self.name, self.key = store, name, f"bank {name}"
        self._found: list[Segment] = []
        self._generation = -1
        self._last: tuple[int, dict[str, np.ndarray]] = (0, {})

    @property
    def header(self) -> dict[str, Any]:
        """Simulator, shapes and names, as they are on the disk."""
        found = self.store.text(self.key)
        if found is None:
            kinds = [kind for kind in self.store.kinds() if kind.startswith("bank ")]
            raise ValueError(
                f"expected the {self.key} in {self.store.path}; got "
                f"{', '.join(kinds) or 'none'}; give name= of one there, or simulator= "
                "to make one"
            )
        require_header(self.store.path, found)
        return found

    def note(self, **entries: Any) -> None:
        """Change entries of the header."""
        with self.store.writing():
            self.store.put(OBJECTS, self.key, 0, {**self.header, **entries})
        self._generation = -1

    def segments(self) -> list[Segment]:
        """Return the segments as they are on the disk now."""
        with self.store.reading():
            total = self.store.length(SEGMENTS, self.name)
            if self._generation != self.store.generation or total < len(self._found):
                self._found, self._last = [], (0, {})
                self._generation = self.store.generation
                self._lost = {*self.header["lost"]}
            first = self._found[-1].number if self._found else 0
            for number in range(first + 1, total + 1):
                if number not in self._lost:
                    found = find_segment(self.store, self.name, number)
                    self._found.append(found)
            return self._found[:]

    def damaged(self) -> dict[int, str]:
        """Return the segments that are not whole, and why."""
        wrong: dict[int, str] = {}
        try:
            numbers = range(1, self.store.length(SEGMENTS, self.name) + 1)
            lost = self.header["lost"]
        except CorruptSegmentError:  # which is a problem of the store
            return {}
        for number in numbers:
            try:
                if number not in lost:
                    found = find_segment(self.store, self.name, number)
                    self.columns(found, (*COLUMNS,))
            except CorruptSegmentError as error:
                wrong[number] = error.reason
        return wrong

    def columns(self, segment: Segment, names: Sequence[str]) -> dict[str, np.ndarray]:
        """Return columns of a segment, which cannot be written to."""
        if self._last[0] != segment.number:
            self._last = segment.number, {}
        kept = self._last[1]
        if lacking := [name for name in names if name not in kept]:
            shapes = self.header["shapes"]
            path = self.store.path
            require(path, shapes is not None, "segments and no shapes of their rows")
            kept |= read_columns(self.store, self.name, segment, lacking, shapes)
        return kept

    def gather(self, names: list[str], rows: np.ndarray | None) -> list[Tensor]:
        """Return columns at positions; None takes all rows."""
        segments = self.segments()
        ends = np.cumsum([0, *(segment.num_rows for segment in segments)])
        rows = np.arange(ends[-1]) if rows is None else rows
        if not segments:
            raise ValueError(
                f"expected rows in {self.store.folder}; got none; simulate into it"
            )
        order = np.argsort(rows, kind="stable")
        bounds = np.searchsorted(rows[order], ends)
        labels = [*dict.fromkeys(segment.label for segment in segments)]
        result: dict[str, np.ndarray] = {}
        for k, segment in enumerate(segments):
            here = order[bounds[k] : bounds[k + 1]]
            if not len(here) and (result or k < len(segments) - 1):
                continue
            own = {"seed": segment.seed, "label": labels.index(segment.label)}
            stored = self.columns(segment, [n for n in names if n not in own])
            for name in names:
                if name in own:
                    value: Any = _whole_number(own[name])
                else:
                    value = stored[name][rows[here] - ends[k]]
                if name not in result:
                    shape, dtype = np.shape(value)[1:], np.asarray(value).dtype
                    result[name] = np.empty((len(rows), *shape), dtype)
                result[name][here] = value
        return [torch.from_numpy(result[name]) for name in names]


def positions(rows: Any, total: int) -> np.ndarray | None:
    """Return the positions of rows, int64; None if all are meant.

    Args:
        rows: Positions, a slice, a mask over all rows, or None.
        total: Number of all rows.

    Raises:
        ValueError: If they are anything else.
    """
    if rows is None:
        return None
    if isinstance(rows, slice):
        return np.arange(*rows.indices(total))
    found = np.asarray(rows)
    if found.dtype == bool and found.shape == (total,):
        return np.flatnonzero(found)
    whole = found.ndim == 1 and found.dtype.kind in "iu"
    if not whole or not bool(((found >= 0) & (found < total)).all()):
        raise ValueError(
            f"expected positions of rows within [0, {total}), or a mask of "
            f"{total}; got {rows!r}; use what columns() is indexed by"
        )
    return found


def _whole_number(value: int) -> np.int64:
    try:
        return np.int64(value)
    except OverflowError as error:
        raise ValueError(
            "expected seeds below 2**63 for a column of them; got one of "
            f"{value.bit_length()} bits; read the other columns"
        ) from error

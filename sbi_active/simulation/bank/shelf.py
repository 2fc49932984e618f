"""The segments of a bank in order: list, add, read, merge and check them.

A segment is named after the numbers that it covers, ``00000004-00000009.h5`` being
what 4 to 9 were merged into. One that is covered by another no longer counts, so a
merger is complete when its result has its name, whatever dies thereafter. The numbers
that count follow each other without a gap, since the position of a row does not change.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from sbi_active.simulation.bank.damage import (
    CorruptSegmentError,
    regular_size,
    require,
)
from sbi_active.simulation.bank.files import synchronize
from sbi_active.simulation.bank.segments import (
    COLUMNS,
    leftovers,
    read_segment,
    write_segment,
)
from sbi_active.simulation.outcomes import Outcome

#: Bytes of a segment: what reading one row may cost in memory.
SEGMENT_BYTES = 64 * 2**20

#: Small segments that are merged by themselves.
MANY = 64

#: What can be read; the last two are those of a row's run.
COLUMN_NAMES = {*COLUMNS} - {"run"} | {"seed", "label"}

NAME = re.compile(r"(\d{8})-(\d{8})\.h5")


@dataclass(frozen=True)
class Segment:
    """A file of rows.

    Attributes:
        path: The file.
        meta: Number of rows, counts by outcome, the runs that rows belong to, and the
            shapes of theta, action and x.
        num_bytes: Size of the file.
    """

    path: Path
    meta: dict[str, Any]
    num_bytes: int

    @property
    def num_rows(self) -> int:
        """Rows in the file."""
        return self.meta["num_rows"]

    @property
    def runs(self) -> list[dict[str, Any]]:
        """Digest, seed and label of each run; the column "run" is an index here."""
        return self.meta["runs"]

    def read(self, names: list[str] | None) -> dict[str, np.ndarray]:
        """Return columns; None reads all."""
        return read_segment(self.path, names)[0]


class Shelf:
    """Segments in a folder.

    Args:
        folder: Need not exist to be read as empty.
        header: Of the bank: which segments are its own, and which are known as lost.

    Attributes:
        header: The latest that is known.
    """

    def __init__(self, folder: Path, header: Mapping[str, Any]) -> None:
        self._folder = folder
        self.header = header
        self._meta: dict[tuple[str, int, int], dict[str, Any]] = {}
        self._small = 0
        self._last: tuple[Path | None, dict[str, np.ndarray]] = (None, {})

    def segments(self) -> list[Segment]:
        """Return the segments as they are on the disk now.

        Raises:
            CorruptSegmentError: If one is not there, cannot be read, or is not of this
                bank and place.
        """
        while True:
            try:
                return [self._open(path) for path in self._paths()]
            except FileNotFoundError:  # merged while being listed
                continue

    def gather(
        self, names: list[str], rows: np.ndarray | None
    ) -> dict[str, np.ndarray]:
        """Return columns at positions; None takes all rows."""
        while True:
            try:
                return self._gather(self.segments(), names, rows)
            except FileNotFoundError:  # merged while being read
                continue

    def add(self, run: dict[str, Any], columns: dict[str, np.ndarray]) -> None:
        """Write rows of a run as new segments, in the order given."""
        row_bytes = sum(column.nbytes for column in columns.values())
        row_bytes /= max(len(columns["index"]), 1)
        size = max(1, int(SEGMENT_BYTES / row_bytes))
        for start in range(0, len(columns["index"]), size):
            part = {name: c[start : start + size] for name, c in columns.items()}
            part["run"] = np.zeros(len(part["index"]), np.int32)
            number = self.last_number() + 1
            self._write(number, number, part, [run])
            self._small += 1
        if self._small > MANY:
            self.compact()

    def compact(self) -> None:
        """Merge neighbors up to the size of a segment; a corrupt one is left alone."""
        group: list[Path] = []
        size = 0
        for path in self._paths():
            added = path.stat().st_size
            is_sound = self._damage(path, whole=False) is None
            if size + added > SEGMENT_BYTES or not is_sound:
                self._merge(group)
                group, size = [], 0
            if is_sound and added <= SEGMENT_BYTES / 2:
                group.append(path)
                size += added
        self._merge(group)
        self._small = 0

    def clean(self) -> None:
        """Remove what a writer that died left; for the writer alone."""
        paths = self._paths()
        for path in [*leftovers(self._folder), *leftovers(self._folder.parent)]:
            path.unlink(missing_ok=True)
        # What a merger was made from goes once its result is seen to be whole.
        covered = {*self._list()} - {*paths}
        if covered and not self.verify():
            for path in covered:
                path.unlink()
        self._small = sum(p.stat().st_size <= SEGMENT_BYTES / 2 for p in paths)

    def verify(self) -> list[str]:
        """Return what is wrong, one line each."""
        paths = self._covering()
        problems = [f"{e.path}: {e.reason}" for e in self._errors(paths)]
        return problems + [f"{p}: {e.reason}" for p in paths if (e := self._damage(p))]

    def set_aside(self) -> None:
        """Rename files that are damaged, so that they do not count."""
        for path in self._covering():
            if self._damage(path):
                path.rename(path.with_name(f"{path.name}.damaged"))

    def last_number(self) -> int:
        """Return the highest number of a segment there; 0 where there is none."""
        return max((_numbers(path)[1] for path in self._covering()), default=0)

    def lost(self, paths: list[Path] | None = None) -> list[list[int]]:
        """Return the numbers that are not there, first to last."""
        paths = self._covering() if paths is None else paths
        spans = [_numbers(path) for path in paths]
        ends = [0, *(last for _, last in spans)]
        end = max(self.header["num_segments"], ends[-1]) + 1
        starts = [*(first for first, _ in spans), end]
        gaps = zip(ends, starts, strict=True)
        return [[end + 1, start - 1] for end, start in gaps if start > end + 1]

    def _paths(self) -> list[Path]:
        """Return the files that count, in order.

        Raises:
            CorruptSegmentError: If their numbers do not follow each other.
        """
        paths = self._covering()
        if not any(self._errors(paths)):
            return paths
        paths = self._covering()  # in case of mergers during the first look
        for error in self._errors(paths):
            raise error
        return paths

    def _errors(self, paths: list[Path]) -> Iterator[CorruptSegmentError]:
        """Yield where the numbers of files do not follow each other."""
        for path, following in pairwise(paths):
            if _numbers(following)[0] <= _numbers(path)[1]:
                yield CorruptSegmentError(following, f"rows of {path.name} in it")
        for first, last in self.lost(paths):
            if not any(a <= first and last <= b for a, b in self.header["lost"]):
                reason = f"a gap: segments {first} to {last} are not there"
                yield CorruptSegmentError(self._folder, reason)

    def _covering(self) -> list[Path]:
        """Return the files that no other one covers, in order."""
        found = self._list()
        # A file that is renamed while a folder is listed may not be seen, and what it
        # was merged from may be gone already.
        while (again := self._list()) != found:
            found = again
        # The widest of those that begin at one number comes first.
        found.sort(key=lambda path: (_numbers(path)[0], -_numbers(path)[1]))
        paths, covered = [], 0
        for path in found:
            if _numbers(path)[1] > covered:
                paths.append(path)
                covered = _numbers(path)[1]
        return paths

    def _list(self) -> list[Path]:
        paths = [p for p in self._folder.glob("*.h5") if NAME.fullmatch(p.name)]
        return sorted(p for p in paths if 1 <= _numbers(p)[0] <= _numbers(p)[1])

    def _open(self, path: Path) -> Segment:
        regular_size(path)
        state = path.stat()
        key = (path.name, state.st_mtime_ns, state.st_size)
        if key not in self._meta:
            meta = read_segment(path, [])[1]
            self._require_in_place(path, meta)
            self._meta[key] = meta
        return Segment(path, self._meta[key], state.st_size)

    def _require_in_place(self, path: Path, meta: dict[str, Any]) -> None:
        numbers, shapes = meta.get("numbers", []), meta["shapes"]  # older ones lack it
        here = numbers in ([], [*_numbers(path)])
        require(path, here, f"segments {numbers} under another name")
        own = meta.get("bank") in (None, self.header["id"])
        require(path, own, "a segment of another bank")
        expected = self.header["shapes"]
        same = expected in (None, shapes)
        require(path, same, f"rows of shapes {shapes} among those of {expected}")
        if expected is None:  # another process wrote the first rows a moment ago
            self.header = {**self.header, "shapes": shapes}

    def _damage(self, path: Path, *, whole: bool = True) -> CorruptSegmentError | None:
        try:
            self._open(path)
            if whole:
                read_segment(path, None)
        except CorruptSegmentError as error:
            return error
        return None

    def _gather(
        self, segments: list[Segment], names: list[str], rows: np.ndarray | None
    ) -> dict[str, np.ndarray]:
        total = sum(segment.num_rows for segment in segments)
        rows = np.arange(total) if rows is None else rows
        result: dict[str, np.ndarray] = {}
        codes: dict[str, int] = {}
        order = np.argsort(rows, kind="stable")
        ordered = rows[order]
        start = 0
        for segment in segments:
            stop = start + segment.num_rows
            for run in segment.runs:
                codes.setdefault(run["label"], len(codes))
            here = order[slice(*np.searchsorted(ordered, [start, stop]))]
            if len(here) or not result:
                columns = self._columns(segment, names, codes)
                for name, column in columns.items():
                    if name not in result:
                        shape = (len(rows), *column.shape[1:])
                        result[name] = np.empty(shape, column.dtype)
                    result[name][here] = column[rows[here] - start]
            start = stop
        if not result:
            raise ValueError(
                f"expected rows in {self._folder.parent}; got none; simulate into "
                "it first"
            )
        return result

    def _columns(
        self, segment: Segment, names: list[str], codes: dict[str, int]
    ) -> dict[str, np.ndarray]:
        stored = ["run" if name in ("seed", "label") else name for name in names]
        if self._last[0] != segment.path or not {*stored} <= self._last[1].keys():
            self._last = (segment.path, segment.read([*dict.fromkeys(stored)]))
        columns = self._last[1]
        of_run = {
            "seed": [run["seed"] for run in segment.runs],
            "label": [codes[run["label"]] for run in segment.runs],
        }
        return {
            name: _whole_numbers(of_run[name])[columns["run"]]
            if name in of_run
            else columns[name]
            for name in names
        }

    def _merge(self, paths: list[Path]) -> None:
        if len(paths) < 2:
            return
        try:
            parts = [read_segment(path, None) for path in paths]
        except CorruptSegmentError:  # found only now: leave all for verify() to name
            return
        runs: dict[str, dict[str, Any]] = {}
        for columns, meta in parts:
            for run in meta["runs"]:
                runs.setdefault(f"{run['digest']} {run['label']}", run)
            keys = [*runs]
            own = [keys.index(f"{r['digest']} {r['label']}") for r in meta["runs"]]
            columns["run"] = np.array(own, np.int32)[columns["run"]]
        merged = {
            name: np.concatenate([columns[name] for columns, _ in parts])
            for name in parts[0][0]
        }
        first, last = _numbers(paths[0])[0], _numbers(paths[-1])[1]
        self._write(first, last, merged, [*runs.values()])
        for path in paths:
            path.unlink()
        synchronize(self._folder)

    def _write(
        self,
        first: int,
        last: int,
        columns: dict[str, np.ndarray],
        runs: list[dict[str, Any]],
    ) -> None:
        meta = {
            "num_rows": len(columns["index"]),
            "counts": [int((columns["status"] == o).sum()) for o in Outcome],
            "runs": runs,
            "numbers": [first, last],
            "bank": self.header["id"],
        }
        path = self._folder / f"{first:08d}-{last:08d}.h5"
        require(path, NAME.fullmatch(path.name) is not None, "no more room for numbers")
        write_segment(path, columns, meta)


def _whole_numbers(values: list[int]) -> np.ndarray:
    try:
        return np.array(values, np.int64)
    except OverflowError as error:
        raise ValueError(
            "expected seeds below 2**63 for a column of them; got one of "
            f"{max(v.bit_length() for v in values)} bits; read the other columns"
        ) from error


def _numbers(path: Path) -> tuple[int, int]:
    match = NAME.match(path.name)
    assert match is not None
    return int(match[1]), int(match[2])

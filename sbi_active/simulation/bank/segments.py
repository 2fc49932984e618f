"""Segments of rows in a store: columns as bytes, and what is known of them.

A segment belongs to one run, and is never changed. The content of a file is compared
with what a bank writes, since valid checksums alone can be forged.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

from sbi_active.simulation.bank.damage import is_count, parsed, require
from sbi_active.simulation.bank.sqlite import SEGMENTS
from sbi_active.simulation.bank.store import Store
from sbi_active.simulation.outcomes import Outcome

#: Bytes of a segment: what reading one row may cost in memory. With 16 MiB, ten rows of
#: 1 MB one by one take four times the CPU, and nothing else takes less
#: (``python -m benchmarks cost.store``).
SEGMENT_BYTES = 4 * 2**20
COLUMNS = {
    "index": np.dtype("<i8"),
    "theta": np.dtype("<f4"),
    "action": np.dtype("<f4"),
    "x": np.dtype("<f4"),
    "status": np.dtype("i1"),
    "log_proposal": np.dtype("<f8"),
    "log_action": np.dtype("<f8"),
}
TABLES = ("theta", "action", "x")  # of more than one number a row


@dataclass(frozen=True)
class Segment:
    """Header of a segment, without its columns.

    Attributes:
        number: Place of the segment among those of the bank, from 1.
        num_rows: Rows in it.
        counts: Counts of rows by outcome.
        run: Name of the run that its rows belong to.
        seed: Seed of the run.
        label: Label of the run's proposal; "" if it is not known.
    """

    number: int
    num_rows: int
    counts: Sequence[int]
    run: str
    seed: int
    label: str


def write_segment(
    store: Store, name: str, run: Mapping[str, Any], columns: Mapping[str, np.ndarray]
) -> None:
    """Write a segment; it is on the disk, whole, when this returns.

    Args:
        store: The file.
        name: Name of the bank.
        run: Run, with ``run``, ``seed`` and ``label``.
        columns: Arrays of the same length, by name.
    """
    counts = [int((columns["status"] == outcome).sum()) for outcome in Outcome]
    known = {**run, "num_rows": len(columns["index"]), "counts": counts}
    with store.writing((SEGMENTS, name)) as number:
        store.put(SEGMENTS, name, number, known)
        for key, kind in COLUMNS.items():
            content = np.ascontiguousarray(columns[key], kind).reshape(-1)
            content = content.view(np.uint8).data
            store.put(SEGMENTS, f"{name}/{key}", number, content)


def find_segment(store: Store, name: str, number: int) -> Segment:
    """Return the header of a segment.

    Raises:
        CorruptSegmentError: If it is not there, or not what a bank writes.
    """
    where = f"segment {number} of {name!r}"
    content = store.get(SEGMENTS, name, number)
    require(store.path, content is not None, f"no {where}: a gap")
    known = parsed(store.path, content or b"")
    keys = known.keys() == {"num_rows", "counts", "run", "seed", "label"}
    require(store.path, keys and _is_known(known), f"{where} that no bank writes")
    size = store.size(SEGMENTS, f"{name}/index", number)
    same = size == COLUMNS["index"].itemsize * known["num_rows"]
    require(store.path, same, f"{where} with another number of rows")
    return Segment(number, **known)


def read_columns(
    store: Store,
    name: str,
    segment: Segment,
    names: Sequence[str],
    shapes: Mapping[str, Sequence[int]],
) -> dict[str, np.ndarray]:
    """Return columns of a segment, which cannot be written to.

    Args:
        store: The file.
        name: Name of the bank.
        segment: Segment to read.
        names: Names of the columns.
        shapes: Shapes of theta, action and x, of a row.

    Raises:
        CorruptSegmentError: If one is not what was written.
    """
    columns = {}
    for key in names:
        where = f"{key!r} of segment {segment.number} of {name!r}"
        content = store.get(SEGMENTS, f"{name}/{key}", segment.number)
        require(store.path, content is not None, f"no {where}")
        assert content is not None
        shape = segment.num_rows, *(shapes[key] if key in TABLES else ())
        size = prod(shape) * COLUMNS[key].itemsize
        require(store.path, len(content) == size, f"{len(content)} bytes as {where}")
        array = np.frombuffer(content, COLUMNS[key]).reshape(shape)
        _require_possible(store.path, where, key, array, segment)
        columns[key] = array
    return columns


def _require_possible(
    path: Path, where: str, key: str, array: np.ndarray, segment: Segment
) -> None:
    if key == "status":
        counts = [int((array == outcome).sum()) for outcome in Outcome]
        require(path, counts == [*segment.counts], f"{where} that no bank writes")
    if key == "index":
        require(path, bool((array >= 0).all()), f"{where} that no bank writes")


def _is_known(known: Mapping[str, Any]) -> bool:
    counts = known["counts"]
    return (
        all(isinstance(known[key], str) for key in ("run", "label"))
        and type(known["seed"]) is int
        and isinstance(counts, list)
        and all(map(is_count, [*counts, known["num_rows"]]))
        and len(counts) == len(Outcome)
        and sum(counts) == known["num_rows"]
    )


def require_header(path: Path, header: Mapping[str, Any]) -> None:
    """Raise if the header of a bank is none that a bank writes.

    Raises:
        CorruptSegmentError: If an entry is missing or wrong; it names the entry.
    """
    for name, is_valid in _ENTRIES.items():
        require(path, name in header, f"no entry {name!r}")
        require(path, is_valid(header[name]), f"an entry {name!r} that none writes")


def _are(kind: type | Callable[[Any], bool], value: Any) -> bool:
    test = (lambda v: isinstance(v, kind)) if isinstance(kind, type) else kind
    return isinstance(value, list) and all(map(test, value))


def _are_shapes(value: Any) -> bool:
    return isinstance(value, dict) and (
        value.keys() == {*TABLES} and all(_are(is_count, v) for v in value.values())
    )


_ENTRIES: dict[str, Callable[[Any], bool]] = {
    "created": lambda value: value is None or isinstance(value, str),
    "version": lambda value: isinstance(value, str),
    "simulator": lambda value: isinstance(value, dict | str),
    "parameter_names": lambda value: value is None or _are(str, value),
    "shapes": lambda value: value is None or _are_shapes(value),
    "lost": lambda value: _are(is_count, value),
}

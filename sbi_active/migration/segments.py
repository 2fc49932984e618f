"""Banks of release 0.1: a header of JSON, and segments of HDF5."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch

from sbi_active.simulation.bank.bank import SHAPED, Bank
from sbi_active.simulation.bank.store import CorruptSegmentError, Store, whole

COLUMNS = (*SHAPED, "status", "index", "log_proposal")
NAME = re.compile(r"(\d{8})-(\d{8})\.h5")


def copy_bank(folder: Path, store: Store, name: str) -> int:
    """Write a bank of earlier into a store, its rows in the same order.

    Args:
        folder: Folder of the bank.
        store: Store that gets the rows.
        name: Name of the bank in the store.

    Returns:
        Number of rows.

    Raises:
        CorruptSegmentError: If a file does not hold what was written, or is not there.
        ImportError: If there are rows, and no h5py.
    """
    path = folder / "bank.json"
    try:
        header = dict(json.loads(path.read_bytes()))
    except (ValueError, TypeError) as error:
        whole(path, False, f"no header ({error})")
    kept = ("created", "version", "simulator", "parameter_names", "shapes")
    lacking = [key for key in kept if key not in header]
    whole(path, not lacking and header.get("format") == 1, "no header of release 0.1")
    with store.writing():
        store.put(f"bank {name}", {key: header[key] for key in kept})
    into, total = Bank(store, name=name), 0
    into._mine = into.header  # which has no function
    for file in _files(folder, header):
        columns, runs = _read(file)
        run = columns.pop("run")
        total += len(run)
        # A segment of now has one run: neighbors of one run go together.
        starts = np.flatnonzero(np.diff(run, prepend=-1))
        for start, stop in pairwise([*starts, len(run)]):
            own = runs[run[start]]
            part = {key: columns[key][start:stop].copy() for key in COLUMNS}
            rows = {key: torch.from_numpy(column) for key, column in part.items()}
            into.save(own["digest"], seed=own["seed"], **rows)
    return total


def _files(folder: Path, header: dict[str, Any]) -> Iterator[Path]:
    """Yield the segments in order; of those that were merged, the result alone."""
    found = [p for p in (folder / "segments").glob("*.h5") if NAME.fullmatch(p.name)]
    spans = {path: tuple(map(int, path.stem.split("-"))) for path in found}
    found.sort(key=lambda path: (spans[path][0], -spans[path][1]))
    numbers, end = [], 0
    for path in found:
        first, last = spans[path]
        if first > end:  # else it is covered by another
            numbers += [*range(end + 1, first)]
            end = last
            yield path
    numbers += [*range(end + 1, header.get("num_segments", 0) + 1)]
    lost = [n for a, b in header.get("lost", []) for n in range(a, b + 1)]
    gone = sorted({*numbers} - {*lost})
    whole(folder / "segments", not gone, f"a gap: segments {gone} are not there")


def _read(path: Path) -> tuple[dict[str, np.ndarray], list[dict[str, Any]]]:
    """Return the columns of a segment, compared with their checksums, and its runs."""
    try:
        import h5py
    except ImportError as error:
        raise ImportError(
            f"expected h5py, to read {path.name}, as an earlier release wrote it; got "
            "none; install it by: pip install 'sbi-active[migrate]'"
        ) from error
    try:
        with open(path, "rb") as opened, h5py.File(opened, "r") as file:
            text = _plain(h5py, file, "meta", path).tobytes()
            same = hashlib.sha256(text).hexdigest() == str(file.attrs["sha256"])
            whole(path, same, "meta data with another checksum")
            meta = json.loads(text)
            names = [*COLUMNS, "log_action", "run"]
            columns = {name: _plain(h5py, file, name, path) for name in names}
        for name, column in columns.items():
            same = _checksum(column) == meta["checksums"][name]
            whole(path, same, f"{name!r} with another checksum")
    except CorruptSegmentError:
        raise
    except Exception as error:  # HDF5 has many
        reason = f"a file that HDF5 cannot read ({error or type(error).__name__})"
        whole(path, False, reason)
    return columns, meta["runs"]


def _plain(h5py: Any, file: Any, name: str, path: Path) -> np.ndarray:
    """Return a dataset: plain numbers within this very file, no larger than it."""
    is_here = isinstance(file.get(name, getlink=True), h5py.HardLink)
    whole(path, is_here, f"{name!r} in another place")
    dataset = file[name]
    plan = dataset.id.get_create_plist()
    is_plain = (
        not plan.get_external_count()
        and not plan.get_nfilters()
        and dataset.dtype.kind in "iuf"
        and dataset.nbytes <= path.stat().st_size
    )
    whole(path, is_plain, f"{name!r} of another kind")
    return dataset[()]


def _checksum(array: np.ndarray) -> str:
    array = np.ascontiguousarray(array)
    digest = hashlib.sha256(f"{array.dtype.str} {array.shape}".encode())
    digest.update(array.reshape(-1).view(np.uint8).data)
    return digest.hexdigest()

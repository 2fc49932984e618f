"""Immutable files of rows: written whole or not at all, and checked at each read.

HDF5 keeps no journal, so a file that is open for writing when its process dies may be
lost altogether. A segment is therefore built in memory, written under another name,
synchronized with the disk, and only then renamed; nothing is ever written to it again.
"""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from sbi_active.simulation.bank.damage import (
    CorruptSegmentError,
    is_count,
    parsed,
    regular_size,
    require,
)
from sbi_active.simulation.bank.files import TEMPORARY, write_file
from sbi_active.simulation.outcomes import Outcome

#: Compare with ``meta`` in the file, which holds the checksums of all columns.
META, CHECKSUM = "meta", "sha256"

COLUMNS = {
    "index": np.dtype(np.int64),
    "theta": np.dtype(np.float32),
    "action": np.dtype(np.float32),
    "x": np.dtype(np.float32),
    "status": np.dtype(np.int8),
    "log_proposal": np.dtype(np.float64),
    "log_action": np.dtype(np.float64),
    "run": np.dtype(np.int32),
}

#: Those of more than one number a row.
TABLES = ("theta", "action", "x")

#: Bytes of a segment of several rows that are read at most; none is written as large.
LARGEST = 2**30


def write_segment(
    path: Path, columns: Mapping[str, np.ndarray], meta: Mapping[str, Any]
) -> None:
    """Write a segment; it is on the disk, whole, when this returns.

    Args:
        path: New file.
        columns: Arrays of the same length n, by name.
        meta: Anything JSON holds, read without the columns.

    Raises:
        OSError: If the disk is full or cannot be written; no file is left.
    """
    checksums = {name: _checksum(array) for name, array in columns.items()}
    text = json.dumps({**meta, "checksums": checksums}).encode()
    buffer = io.BytesIO()
    # From 1.8 on all of HDF5's own structure has checksums; without them a flipped bit
    # can make it read for ever.
    with h5py.File(buffer, "w", libver=("v108", "v108")) as file:
        for name, array in columns.items():
            file.create_dataset(name, data=array)
        file.create_dataset(META, data=np.frombuffer(text, np.uint8))
        file.attrs[CHECKSUM] = hashlib.sha256(text).hexdigest()
    write_file(path, buffer.getvalue())


def read_segment(
    path: Path, names: Sequence[str] | None
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Return columns, each compared with its checksum, and the meta data.

    A file made by somebody else is read without harm: it can name no other file and
    no filter to load, and takes no more memory than its size.

    Args:
        path: A segment.
        names: Columns to read; None reads all.

    Returns:
        The columns, and the meta data with the ``shapes`` of theta, action and x.

    Raises:
        FileNotFoundError: If there is no such file.
        CorruptSegmentError: If the file is not what was written.
    """
    size = regular_size(path)
    try:
        # HDF5 looks its path up more than once, and the file may be gone by then.
        with open(path, "rb") as opened, h5py.File(opened, "r") as file:
            meta = _meta(path, file, size)
            wanted = COLUMNS if names is None else names
            looked_at = {*wanted, *TABLES}
            datasets = {n: _dataset(path, file, n, size) for n in looked_at}
            _require_rows(path, datasets, meta)
            meta["shapes"] = {name: [*datasets[name].shape[1:]] for name in TABLES}
            columns = {name: datasets[name][()] for name in wanted}
    except (FileNotFoundError, CorruptSegmentError):
        raise
    except Exception as error:  # HDF5 has many
        reason = f"a file that HDF5 cannot read ({error or type(error).__name__})"
        raise CorruptSegmentError(path, reason) from error
    for name, array in columns.items():
        same = _checksum(array) == meta["checksums"][name]
        require(path, same, f"{name!r} with another checksum")
        require(path, _is_possible(name, array, meta), f"{name!r} that no bank holds")
    return columns, meta


def _meta(path: Path, file: h5py.File, size: int) -> dict[str, Any]:
    text = _dataset(path, file, META, size)[()].tobytes()
    same = hashlib.sha256(text).hexdigest() == str(file.attrs[CHECKSUM])
    require(path, same, "meta data with another checksum")
    meta = parsed(path, text)
    keys = meta.keys() >= {"num_rows", "counts", "runs", "checksums"}
    require(path, keys and _is_meta(meta), "meta data that no bank writes")
    return meta


def _is_meta(meta: Mapping[str, Any]) -> bool:
    counts, runs, checksums = meta["counts"], meta["runs"], meta["checksums"]
    numbers = meta.get("numbers", [])
    return (
        all(isinstance(value, list) for value in (counts, runs, numbers))
        and all(map(is_count, [*counts, *numbers, meta["num_rows"]]))
        and len(counts) == len(Outcome)
        and sum(counts) == meta["num_rows"]
        and all(isinstance(run, dict) and _is_run(run) for run in runs)
        and isinstance(checksums, dict)
        and checksums.keys() == COLUMNS.keys()
    )


def _is_run(run: Mapping[str, Any]) -> bool:
    named = all(isinstance(run.get(name), str) for name in ("digest", "label"))
    return named and type(run.get("seed")) is int


def _dataset(path: Path, file: h5py.File, name: str, size: int) -> h5py.Dataset:
    """Return a dataset without reading it: plain numbers within this very file."""
    link = file.get(name, getlink=True)
    require(path, isinstance(link, h5py.HardLink), f"{name!r} in another place")
    dataset = file[name]
    assert isinstance(dataset, h5py.Dataset)
    kind = COLUMNS.get(name, np.dtype(np.uint8))
    plan = dataset.id.get_create_plist()
    is_plain = (
        dataset.dtype == kind
        and plan.get_layout() in (h5py.h5d.CONTIGUOUS, h5py.h5d.COMPACT)
        and not plan.get_external_count()
        and not plan.get_nfilters()
        and dataset.shape is not None
    )
    require(path, is_plain, f"{name!r} of another kind")
    num_rows = dataset.shape[0] if dataset.shape else 0
    few = dataset.nbytes <= (size if num_rows <= 1 else min(size, LARGEST))
    require(path, few, f"{name!r} of {dataset.nbytes} bytes")
    return dataset


def _require_rows(
    path: Path, datasets: Mapping[str, h5py.Dataset], meta: Mapping[str, Any]
) -> None:
    for name, dataset in datasets.items():
        long = dataset.shape[:1] == (meta["num_rows"],)
        fits = long and (name in TABLES or len(dataset.shape) == 1)
        require(path, fits, f"{name!r} of shape {dataset.shape}")


def _is_possible(name: str, array: np.ndarray, meta: Mapping[str, Any]) -> bool:
    if name == "status":
        counts = [int((array == outcome).sum()) for outcome in Outcome]
        return counts == meta["counts"]
    if name == "run":
        return bool(((array >= 0) & (array < len(meta["runs"]))).all())
    return name != "index" or bool((array >= 0).all())


def leftovers(folder: Path) -> Iterator[Path]:
    """Yield files of writers that died while writing."""
    yield from folder.glob(f"{TEMPORARY}*")


def _checksum(array: np.ndarray) -> str:
    array = np.ascontiguousarray(array)
    digest = hashlib.sha256(f"{array.dtype.str} {array.shape}".encode())
    digest.update(array.reshape(-1).view(np.uint8).data)
    return digest.hexdigest()

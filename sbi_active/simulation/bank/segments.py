"""Immutable files of rows: written whole or not at all, and checked at each read.

HDF5 keeps no journal, so a file that is open for writing when its process dies may be
lost altogether. A segment is therefore built in memory, written under another name,
synchronized with the disk, and only then renamed; nothing is ever written to it again.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np

__all__ = ["CorruptSegmentError", "read_segment", "write_file", "write_segment"]

TEMPORARY = ".writing-"

#: Compare with ``meta`` in the file, which holds the checksums of all columns.
META, CHECKSUM = "meta", "sha256"


class CorruptSegmentError(OSError):
    """A file of a bank that does not hold what was written to it.

    Attributes:
        path: The file.
    """

    def __init__(self, path: Path, reason: str) -> None:
        self.path, self.reason = path, reason
        super().__init__(
            f"expected {path} as it was written; got {reason}; do restore it from a "
            "copy, or delete it: its rows can be simulated again"
        )


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
    with h5py.File(buffer, "w") as file:
        for name, array in columns.items():
            file.create_dataset(name, data=array)
        file.create_dataset(META, data=np.frombuffer(text, np.uint8))
        file.attrs[CHECKSUM] = hashlib.sha256(text).hexdigest()
    write_file(path, buffer.getvalue())


def read_segment(
    path: Path, names: Sequence[str] | None
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Return columns, each compared with its checksum, and the meta data.

    Args:
        path: A segment.
        names: Columns to read; None reads all.

    Raises:
        FileNotFoundError: If there is no such file.
        CorruptSegmentError: If the file is not what was written.
    """
    try:
        # HDF5 looks its path up more than once, and the file may be gone by then.
        with open(path, "rb") as opened, h5py.File(opened, "r") as file:
            text = _dataset(file, META).tobytes()
            if hashlib.sha256(text).hexdigest() != file.attrs[CHECKSUM]:
                raise CorruptSegmentError(path, "meta data with another checksum")
            meta = json.loads(text)
            names = [*meta["checksums"]] if names is None else names
            columns = {name: _dataset(file, name) for name in names}
    except (FileNotFoundError, CorruptSegmentError):
        raise
    except (OSError, KeyError, ValueError, RuntimeError) as error:
        reason = f"a file that HDF5 cannot read ({error})"
        raise CorruptSegmentError(path, reason) from error
    for name, array in columns.items():
        if _checksum(array) != meta["checksums"][name]:
            raise CorruptSegmentError(path, f"{name!r} with another checksum")
    return columns, meta


def write_file(path: Path, content: bytes) -> None:
    """Write a file so that its name never stands for less than its whole content.

    Raises:
        OSError: As the system gives it; the former file, if any, is untouched.
    """
    temporary = path.with_name(f"{TEMPORARY}{os.getpid()}-{path.name}")
    try:
        with open(temporary, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
        synchronize(path.parent)
    except OSError as error:
        with contextlib.suppress(OSError):
            temporary.unlink()
        raise type(error)(
            error.errno,
            f"expected to write {len(content)} bytes; got {error.strerror!r}; do make "
            "room or choose a place that can be written, and run again: what was "
            "stored before is whole",
            str(path),
        ) from error


def synchronize(folder: Path) -> None:
    """Make the names in a folder durable; file systems differ in whether they are."""
    if os.name != "posix":  # elsewhere a folder cannot be opened, nor needs it
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def leftovers(folder: Path) -> Iterator[Path]:
    """Yield files of writers that died while writing."""
    yield from folder.glob(f"{TEMPORARY}*")


def _dataset(file: h5py.File, name: str) -> np.ndarray:
    dataset = file[name]
    assert isinstance(dataset, h5py.Dataset)
    return dataset[()]


def _checksum(array: np.ndarray) -> str:
    array = np.ascontiguousarray(array)
    digest = hashlib.sha256(f"{array.dtype.str} {array.shape}".encode())
    digest.update(array.reshape(-1).view(np.uint8).data)
    return digest.hexdigest()

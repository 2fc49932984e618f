"""Files that are written whole or not at all."""

from __future__ import annotations

import contextlib
import os
import shutil
from pathlib import Path

TEMPORARY = ".writing-"


def write_file(path: Path, content: bytes) -> None:
    """Write a file so that its name never stands for less than its whole content.

    Raises:
        OSError: If the system refuses it; the former file, if any, is untouched.
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
            f"expected to write {len(content)} bytes; got {error.strerror!r}; make "
            "room or choose a place that can be written, and run again: what was "
            "stored before is whole",
            str(path),
        ) from error


def keep_aside(path: Path) -> None:
    """Keep a file under a name ending in ".damaged" too, beside those of before."""
    number, copy = 1, path.with_name(f"{path.name}.damaged")
    while copy.exists():
        number += 1
        copy = path.with_name(f"{path.name}.damaged-{number}")
    try:
        os.link(path, copy)
    except OSError:  # a file system without
        shutil.copy2(path, copy)


def synchronize(folder: Path) -> None:
    """Make the names in a folder durable; file systems differ in whether they are."""
    if os.name != "posix":  # elsewhere a folder cannot be opened, nor needs it
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)

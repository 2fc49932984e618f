"""The border to the disk: what is read is what was written, or one error names it."""

from __future__ import annotations

import json
import os
import platform
import stat
from pathlib import Path
from typing import Any

from sbi_active.messages import Explained

#: Lists and objects within each other; a fingerprint has about 30 at most.
DEEPEST = 100


class CorruptSegmentError(Explained, OSError):
    """A file of a bank that does not hold what was written to it, or is not there.

    Attributes:
        path: The file, or the folder where one is not there.
        reason: Text that says what is wrong with it.
    """

    code = "SA605"

    def __init__(self, path: Path, reason: str) -> None:
        self.path, self.reason = path, reason
        super().__init__(
            f"expected {path} as it was written; got {reason}; restore it from a copy, "
            "or open the bank with its simulator and call repair(), which gives up "
            "rows that are lost: they can be simulated again"
        )


class LockedError(Explained, OSError):
    """Somebody else is writing.

    Attributes:
        pid: Process that holds the lock, None if it did not say.
    """

    code = "SA608"

    def __init__(self, folder: Path, pid: int | None, host: str) -> None:
        self.pid = pid
        here = " (this one)" if pid == os.getpid() and host == platform.node() else ""
        super().__init__(
            f"expected no other writer of {folder}; got process {pid}{here} on "
            f"{host}; wait for it, call close() there, or write to a folder of your "
            "own: any number of readers may go on"
        )


def require_no_link(path: Path) -> None:
    """Raise if a file that is written to is a link: it would lead elsewhere.

    Raises:
        OSError: If the path is a symbolic link.
    """
    if path.is_symlink():
        raise OSError(
            f"expected {path} as a file; got a link to {path.readlink()}; remove it, "
            "after a look at where the folder comes from"
        )


def require(path: Path, holds: bool, reason: str) -> None:
    """Raise if something does not hold.

    Raises:
        CorruptSegmentError: If it does not hold, with the reason.
    """
    if not holds:
        raise CorruptSegmentError(path, reason)


def regular_size(path: Path) -> int:
    """Return the bytes of a file, which is no pipe or device that would be waited for.

    Raises:
        FileNotFoundError: If nothing has this name.
        CorruptSegmentError: If something other than a file has it.
    """
    try:
        state = path.stat()
    except OSError as error:
        if path.is_symlink():
            raise CorruptSegmentError(path, f"a link to nothing ({error})") from error
        raise
    require(path, stat.S_ISREG(state.st_mode), "something that is no file")
    return state.st_size


def parsed(path: Path, content: bytes) -> dict[str, Any]:
    """Return the JSON object in a file.

    Args:
        path: Named in the error.
        content: Bytes of the record, or those of the text within.

    Raises:
        CorruptSegmentError: If it is no object, or one that no bank writes.
    """
    try:
        value = json.loads(content.decode(), parse_constant=_refused)
        _require_flat(value, DEEPEST)
    except (ValueError, RecursionError, MemoryError) as error:
        reason = f"no JSON that a bank writes ({error or type(error).__name__})"
        raise CorruptSegmentError(path, reason) from error
    require(path, isinstance(value, dict), f"{type(value).__name__}, no JSON object")
    return value


def is_count(value: Any) -> bool:
    """Return whether it is a whole number that can count rows."""
    return type(value) is int and 0 <= value < 2**63


def _refused(constant: str) -> float:
    raise ValueError(f"{constant} in it")


def _require_flat(value: Any, depth: int) -> None:
    if depth == 0:
        raise ValueError(f"nested more than {DEEPEST} times")
    if isinstance(value, dict | list):
        for item in value.values() if isinstance(value, dict) else value:
            _require_flat(item, depth - 1)

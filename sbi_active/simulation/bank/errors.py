"""Errors of a store, and what becomes one of them."""

from __future__ import annotations

import errno
import re
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sbi_active.messages import Explained

#: SQLite's errors that say nothing against the file.
OF_THE_DISK = re.compile("locked|full|readonly|disk I/O|unable to open|too big")


class CorruptSegmentError(Explained, OSError):
    """A file of a bank or campaign that does not hold what was written to it.

    Attributes:
        path: The file.
        reason: Text that says what is wrong with it.
    """

    code = "SA605"

    def __init__(self, path: Path, reason: str) -> None:
        self.path, self.reason = path, reason
        text = f"expected {path} as it was written; got {reason}"
        super().__init__(f"{text}; restore it from a copy")


class LockedError(Explained, OSError):
    """Somebody else is writing."""

    code = "SA608"


def whole(path: Path, holds: bool, reason: str) -> None:
    """Raise a CorruptSegmentError, with a reason, unless something holds of a file."""
    if not holds:
        raise CorruptSegmentError(path, reason)


@contextmanager
def sensible(path: Path) -> Iterator[None]:
    """Turn errors of SQLite, and of content without sense, into this library's."""
    try:
        yield
    except OSError:
        raise
    except Exception as error:  # what a crafted file leads to has no end
        text = f"{type(error).__name__}: {error!s:.200}"
        if not (isinstance(error, sqlite3.Error) and OF_THE_DISK.search(text)):
            raise CorruptSegmentError(path, f"content that leads to {text}") from error
        if "locked" in text:
            raise LockedError(
                f"expected no other writer of {path.parent}; got one; wait for it, "
                "call close() there, or write to a folder of your own: any number of "
                "readers may go on"
            ) from error
        raise OSError(
            errno.ENOSPC if "full" in text else errno.EIO,
            f"expected to read and write; got {text!r}; make room or choose a place "
            "that can be written, and run again: what was stored before is whole",
            str(path),
        ) from error

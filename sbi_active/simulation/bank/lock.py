"""One writer at a time, told apart from the dead ones by the operating system."""

from __future__ import annotations

import json
import os
import platform
from pathlib import Path

import filelock

from sbi_active.messages import Explained


class LockedError(Explained, OSError):
    """Somebody else is writing.

    Attributes:
        pid: Process that holds the lock, None where it did not say.
    """

    def __init__(self, folder: Path, pid: int | None, host: str) -> None:
        self.pid = pid
        here = " (this one)" if pid == os.getpid() and host == platform.node() else ""
        super().__init__(
            f"expected no other writer of {folder}; got process {pid}{here} on "
            f"{host}; wait for it, call close() there, or write to a bank of your "
            "own: any number of readers may go on"
        )


class WriterLock:
    """Exclusive right to write to a folder, lost with the process that holds it.

    Args:
        folder: Of the bank.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._lock = filelock.FileLock(folder / "writer.lock", thread_local=False)
        # The lock file itself is truncated by whoever tries to lock it.
        self._holder = folder / "writer.json"

    def __enter__(self) -> WriterLock:
        self.acquire()
        return self

    def __exit__(self, *_: object) -> None:
        self.release()

    @property
    def held(self) -> bool:
        """Whether this object holds the lock."""
        return self._lock.is_locked

    def acquire(self) -> None:
        """Take the lock.

        Raises:
            LockedError: If another writer, in this process or another, holds it.
        """
        try:
            self._lock.acquire(timeout=0)
        except filelock.Timeout as error:
            raise LockedError(self._folder, *self._read_holder()) from error
        except OSError as error:
            raise type(error)(
                error.errno,
                f"expected to lock a bank for writing; got {error.strerror!r}; "
                "choose a place that can be written, or open the bank without "
                "simulator= to read it",
                str(self._folder),
            ) from error
        text = json.dumps({"pid": os.getpid(), "host": platform.node()})
        self._holder.write_text(text)

    def release(self) -> None:
        """Give the lock back; nothing happens where it is not held."""
        if self.held:
            self._holder.unlink(missing_ok=True)
            self._lock.release()

    def _read_holder(self) -> tuple[int | None, str]:
        try:
            holder = json.loads(self._holder.read_text())
            return int(holder["pid"]), str(holder["host"])
        except Exception:  # it locked a moment ago, or somebody else wrote the file
            return None, platform.node()

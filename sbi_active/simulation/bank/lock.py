"""One writer at a time, told apart from the dead ones by the operating system."""

from __future__ import annotations

import json
import os
import platform
from pathlib import Path

import filelock

from sbi_active.simulation.bank.damage import LockedError, require_no_link
from sbi_active.simulation.bank.files import write_file

_inherited: list[filelock.BaseFileLock] = []


class WriterLock:
    """Exclusive right to write to a folder, lost with the process that holds it.

    Args:
        folder: Of the bank.
    """

    def __init__(self, folder: Path) -> None:
        self._folder, self._process = folder, os.getpid()
        self._lock = self._new()
        # The lock file itself is truncated by whoever tries to lock it.
        self._holder = folder / "writer.json"

    def __enter__(self) -> WriterLock:
        self.acquire()
        return self

    def __exit__(self, *_: object) -> None:
        self.release()

    def _new(self) -> filelock.BaseFileLock:
        return filelock.FileLock(self._folder / "writer.lock", thread_local=False)

    @property
    def held(self) -> bool:
        """Whether this object holds the lock, in this process."""
        return self._lock.is_locked and self._process == os.getpid()

    def acquire(self) -> None:
        """Take the lock.

        Raises:
            LockedError: If another writer, in this process or another, holds it.
        """
        if self._process != os.getpid():
            # A forked child does not hold what its parent does, and must not give it
            # back: the object that it inherited stays.
            _inherited.append(self._lock)
            self._lock, self._process = self._new(), os.getpid()
        require_no_link(self._folder / "writer.lock")
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
        # By another name: a link in a folder that somebody sent leads to his file.
        write_file(self._holder, text.encode())

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

"""A store of sealed records in a folder: of banks and of campaigns.

It is one SQLite file, which may come from anybody: nothing in it is executed, its table
is checked before anything is read, and no foreign journal or link is followed.

A record has a kind, a number and a content. A catalog lists the records of a series,
which are numbered from 1. Checksums cover all three and the file's own name, since
SQLite has checksums of its log alone.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import re
import secrets
import sqlite3
import stat
import threading
import weakref
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any
from urllib.parse import quote

from sbi_active.expected import require
from sbi_active.messages import Explained

NAME, FORMAT = "store.db", 4  # format 1 was folders of HDF5
#: Names of an empty file that a writer locks, and of a file that is being written.
LOCK, TEMPORARY = "store.lock", ".writing-"
CATALOG = "catalog"  # the last number of each kind
#: The digest stands before the content, whose pages are then read only for it.
SCHEMA = (
    "CREATE TABLE records (kind TEXT NOT NULL, number INTEGER NOT NULL, digest BLOB "
    "NOT NULL, content BLOB NOT NULL, PRIMARY KEY (kind, number))"
)
#: A record is changed in its place: one that moved to the end would touch more pages.
WRITE = "INSERT INTO records VALUES (?, ?, ?, ?) ON CONFLICT DO UPDATE SET "
WRITE += "digest = excluded.digest, content = excluded.content"
#: The log begins anew before it outgrows its room. With four times of both, the first
#: commit of a process takes twice as long; with a quarter, blocks of rows do.
SETTINGS = (
    "PRAGMA trusted_schema = OFF; PRAGMA cell_size_check = ON; PRAGMA journal_mode = "
    "WAL; PRAGMA synchronous = FULL; PRAGMA wal_autocheckpoint = 240; BEGIN"
)
#: Seconds to wait for a moment in which another process tidies up. A choice.
PATIENCE = 10.0
OTHERWISE = "or update a folder of release 0.1: sbi-active migrate DIR"
#: SQLite's errors that say nothing against the file.
OF_THE_DISK = re.compile("locked|full|readonly|disk I/O|unable to open|too big")


class CorruptSegmentError(Explained, OSError):
    """A file of a bank or campaign that does not hold what was written to it."""

    code = "SA605"


class LockedError(Explained, OSError):
    """Somebody else is writing."""

    code = "SA608"


class LogChangedError(Explained, ValueError):
    """Another writer added to a campaign since it was loaded here."""

    code = "SA607"


def whole(path: Path, holds: bool, reason: str) -> None:
    """Raise a CorruptSegmentError, with a reason, unless something holds of a file."""
    if not holds:
        text = f"expected {path} as it was written; got {reason}"
        raise CorruptSegmentError(f"{text}; restore it from a copy")


@contextmanager
def sensible(path: Path) -> Iterator[None]:
    """Turn errors of SQLite, and of content without sense, into this library's."""
    try:
        yield
    except (OSError, LogChangedError):
        raise
    except Exception as error:  # what a crafted file leads to has no end
        text = f"{type(error).__name__}: {error!s:.200}"
        of_disk = isinstance(error, sqlite3.Error) and bool(OF_THE_DISK.search(text))
        whole(path, of_disk, f"content that leads to {text}")
        if "locked" in text:
            other = f"expected no other writer of {path.parent}; got one"
            raise LockedError(f"{other}; wait, or call close() there") from error
        raise OSError(
            errno.ENOSPC if "full" in text else errno.EIO,
            f"expected to read and write; got {text!r}; make room or choose a place "
            "that can be written, and run again: what was stored before is whole",
            str(path),
        ) from error


#: One thread at a time reads or writes, and none while the process forks.
GUARD = threading.RLock()
_STORES: weakref.WeakSet[Store] = weakref.WeakSet()


class Store:
    """A file of records in a folder. Any number of processes read, and one writes.

    Readers open the file for each read; a writer keeps it open until it is closed.

    Args:
        folder: Folder that has or gets the file.
        what: Name of the store in errors, "bank" or "campaign".
        make: Make the file where there is none.

    Attributes:
        folder: Folder of the file.
        path: The file.

    Raises:
        ValueError: If there is none to open, or the folder holds anything else.
        CorruptSegmentError: If the file does not hold what was written; reads raise it.
    """

    def __init__(self, folder: Path, what: str = "bank", *, make: bool = False) -> None:
        self.folder, self.path, self._what = folder, folder / NAME, what
        self._connection: Any = None
        self._lock: Any = None
        with GUARD:
            _STORES.add(self)
        if make and not os.path.lexists(self.path):
            self._make()
        with self.reading():
            pass

    def __del__(self) -> None:
        with suppress(Exception):
            self.close()

    @contextmanager
    def reading(self) -> Iterator[Any]:
        """Yield the connection for a look at one state, in this thread alone.

        Raises:
            CorruptSegmentError: If the file is damaged, or anything fails while its
                content is made sense of in the block.
            LockedError: If another process holds it for longer than it takes to read.
            OSError: If the disk is full or cannot be read.
        """
        with GUARD:
            opens, keeps = self._connection is None, False
            try:
                if opens:
                    self._open()
                with sensible(self.path):
                    yield self._connection
                keeps = self._lock is not None
            finally:
                if opens and not keeps:
                    self._drop("_connection")

    @contextmanager
    def writing(self, series: str = "", length: int = 0) -> Iterator[None]:
        """Write all that is put in the block, or nothing; on the disk at its end.

        Args:
            series: Series that this is written after, if any.
            length: Number of its records, as they are known here.

        Raises:
            LockedError: If somebody else has the right to write.
            LogChangedError: If the series has another length; nothing is written.
            OSError: If the disk is full or cannot be written.
        """
        with GUARD:
            self.acquire()
            with self.reading() as connection:
                same = self.seal() == self._left
                whole(self.path, same, "another file; nothing was written to it now")
                connection.execute("BEGIN IMMEDIATE")
                try:
                    self._listed = self.catalog
                    if series and self._listed.get(series, 0) != length:
                        self._drop("_lock")  # others may go on
                        told = f"expected {self.folder} as it was loaded; got trials of"
                        raise LogChangedError(f"{told} another process; load it again")
                    yield
                    connection.commit()
                finally:
                    connection.rollback()  # of what was not committed
                    self._left = self.seal()

    def acquire(self) -> None:
        """Take the right to write, which ends with :meth:`close` or the process.

        Raises:
            LockedError: If another writer, in this process or another, has it.
            OSError: If the folder cannot be written.
        """
        if self._lock is not None:
            return
        with GUARD, sensible(self.folder / LOCK):
            lock = _connected(self.folder / LOCK, "rwc", timeout=0.1)
            # Nothing is written.
            lock.executescript("PRAGMA journal_mode = MEMORY; BEGIN EXCLUSIVE")
            self._lock = lock

    def close(self) -> None:
        """Let others write. The next call opens the file again."""
        with GUARD:
            self._drop("_connection", "_lock")

    def get(self, kind: str, number: int = 0) -> bytes | None:
        """Return the content of a record; None if there is none."""
        read = "SELECT content, digest FROM records WHERE kind = ? AND number = ?"
        with self.reading() as connection:
            found = connection.execute(read, (kind, number)).fetchone()
            if found is None:
                listed = kind == CATALOG or number <= self.catalog.get(kind, -1)
                whole(self.path, not listed, f"no {kind!r} {number}: a gap")
                return None
            same = found[1] == _digest(self._id, kind, number, found[0])
            whole(self.path, same, f"{kind!r} {number} with another checksum")
            return found[0]

    def json(self, kind: str, number: int = 0) -> dict[str, Any] | None:
        """Return the JSON object in a record; None if there is none."""
        with self.reading():
            content = self.get(kind, number)
            return None if content is None else dict(json.loads(content))

    @property
    def catalog(self) -> dict[str, int]:
        """The last number of each kind."""
        return self.json(CATALOG) or {}

    def seal(self, *ends: str) -> str:
        """Return a text that changes if the file does, or those of other endings."""
        files = [f"{self.path}{end}" for end in ("", *ends)]
        states = [os.stat(file) for file in files if os.path.exists(file)]
        return str([(s.st_ino, s.st_size, s.st_mtime_ns) for s in states])

    def put(self, kind: str, content: Any, number: int = 0) -> None:
        """Write a record in place of another; for use in :meth:`writing`.

        Args:
            kind: Kind of the record.
            content: Bytes, or JSON data.
            number: Number of the record; 0 of one that is no series.
        """
        if number > self._listed.get(kind, -1):
            self._listed[kind] = number
            _insert(self._connection, self._id, CATALOG, 0, self._listed)
        _insert(self._connection, self._id, kind, number, content)

    def append(self, series: str, content: Any) -> None:
        """Write the next record of a series, in :meth:`writing`."""
        self.put(series, content, self._listed.get(series, 0) + 1)

    def verify(self) -> None:
        """Read every byte of the file.

        Raises:
            CorruptSegmentError: If it does not hold what was written.
        """
        with self.reading() as connection:
            found = connection.execute("PRAGMA integrity_check(1)").fetchone()[0]
            whole(self.path, found == "ok", found)
            for kind, last in self.catalog.items():
                for number in range(min(last, 1), last + 1):
                    self.get(kind, number)

    def _make(self) -> None:
        """Make the file in a folder of its own, which is made where there is none."""
        folder, known = self.folder, (".", NAME, LOCK)  # of writers that were killed
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            error.strerror = f"expected a folder; got {error.strerror}; choose another"
            raise
        other = sorted(p.name for p in folder.iterdir() if not p.name.startswith(known))
        expected, got = f"an empty folder for a {self._what}", f"{folder} with {other}"
        require(not other, expected, got, f"choose another folder, {OTHERWISE}")
        fresh, name = folder / f"{TEMPORARY}{os.getpid()}-{NAME}", secrets.randbits(31)
        fresh.unlink(missing_ok=True)
        made = sqlite3.connect(fresh, isolation_level=None)
        with sensible(fresh), closing(made):
            own = f"PRAGMA user_version = {FORMAT}; PRAGMA application_id = {name}"
            made.executescript(f"PRAGMA journal_mode = WAL; {own}; {SCHEMA}")
            _insert(made, name, CATALOG, 0, {})
        if not self.path.exists():  # nobody was faster
            os.replace(fresh, self.path)
            synchronize(folder)

    def _open(self) -> None:
        """Open the file, whose table must be that of a store."""
        path, advice = self.path, f"check the path, make a {self._what}, {OTHERWISE}"
        require(os.path.lexists(path), f"a {self._what}", f"no {path}", advice)
        # Where a reader's notes cannot be written, or would keep the owner from
        # writing, the file is read as it is.
        is_still = not all(os.access(p, os.W_OK) for p in (path, path.parent))
        is_still &= not path.with_name(f"{NAME}-wal").exists()
        mode = "ro&immutable=1" if is_still else "rw"
        self._connection = _connected(path, mode, timeout=PATIENCE)
        execute = self._connection.execute
        with sensible(path):
            self._connection.executescript(SETTINGS)
            form = execute("PRAGMA user_version").fetchone()[0]
            self._id = execute("PRAGMA application_id").fetchone()[0]
            tables = execute("SELECT sql FROM sqlite_master").fetchall()
            if self._lock is not None:
                execute("COMMIT")
        expected, got = f"a {self._what} of format {FORMAT}", f"{form} in {path}"
        require(form == FORMAT, expected, got, "use the release that wrote it")
        is_own = tables == [(SCHEMA,), (None,)]  # the table, and the index of its key
        whole(path, is_own, "tables that are not those of a store")
        if self._lock is not None:
            # Into a log that need not grow, here for 254 pages, a commit takes half of
            # the time or less. Where the disk has no room, it is as well.
            with suppress(OSError), open(f"{path}-wal", "r+b") as log:
                if log.seek(0, os.SEEK_END) == 0:
                    log.write(bytes(2**20))
        self._left = self.seal()

    def _drop(self, *names: str) -> None:
        """Close the connection to the file, or the lock, where it is held."""
        for name in names:
            held = getattr(self, name)
            setattr(self, name, None)
            if held is not None:
                held.close()


def synchronize(folder: Path) -> None:
    """Make the names in a folder durable; file systems differ in whether they are."""
    if os.name == "posix":  # elsewhere a folder cannot be opened, nor needs it
        descriptor = os.open(folder, os.O_RDONLY)
        os.fsync(descriptor)
        os.close(descriptor)


def _connected(path: Path, mode: str, *, timeout: float) -> sqlite3.Connection:
    """Return a connection that begins no transaction by itself.

    Args:
        path: The file.
        mode: Mode as SQLite names it, "rw" or "rwc".
        timeout: Seconds to wait for others.

    Raises:
        CorruptSegmentError: If it is a link, which leads elsewhere, or a pipe or a
            folder; or there is a journal, which SQLite would write back, here and to
            whatever else it names.
    """
    for end in ("", "-wal", "-shm", "-journal"):
        file = path.with_name(path.name + end)
        reason = f"{file.name}, a link, no file, or a journal, which none leaves"
        with suppress(FileNotFoundError):  # asked once: another may begin it meanwhile
            is_plain = stat.S_ISREG(file.lstat().st_mode) and end != "-journal"
            whole(path, is_plain, reason)
    place = f"file:{quote(str(path.absolute()))}?mode={mode}"
    how: Any = {"isolation_level": None, "check_same_thread": False}
    return sqlite3.connect(place, uri=True, timeout=timeout, **how)


def _insert(at: Any, name: int, kind: str, number: int, content: Any) -> None:
    """Write a record with its digest, in a store of a name."""
    if isinstance(content, dict):
        content = json.dumps(content, allow_nan=False).encode()
    at.execute(WRITE, (kind, number, _digest(name, kind, number, content), content))


def _digest(name: int, kind: str, number: int, content: bytes) -> bytes:
    """Return the checksum of a record, in a store of a name."""
    digest = hashlib.sha256(f"{name} {kind} {number} ".encode())
    digest.update(content)
    return digest.digest()


def _before_fork() -> None:
    """Close connections, which a child must not have, once they are not in use."""
    GUARD.acquire()
    for store in _STORES:
        store._drop("_connection")


def _in_child() -> None:
    """Give back what a child has no right to: that of its parent to write."""
    for store in _STORES:
        store._drop("_lock")
    GUARD.release()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=_before_fork, after_in_parent=GUARD.release)
    os.register_at_fork(after_in_child=_in_child)

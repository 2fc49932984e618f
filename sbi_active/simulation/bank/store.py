"""A store of sealed records in a folder: of banks and of campaigns.

It is one SQLite file, which may come from anybody: nothing in it is executed. Its table
is compared with that of a store before anything is read from it, no journal is played
back that none leaves, and no link is followed.

A record has a kind, a number, a head and a body, which is read apart: that of rows is
what they measure. Records of a series are numbered from 1, and a catalog says which
there are. Checksums cover kind, number and the file's own name, so that bytes that were
changed, exchanged, lost or come from elsewhere are noticed: SQLite itself has checksums
of its log alone.
"""

from __future__ import annotations

import hashlib
import json
import os
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
from sbi_active.simulation.bank.errors import sensible, whole

NAME, FORMAT = "store.db", 3  # format 1 was folders of HDF5, 2 had three tables
LOCK = "store.lock"  # empty: who writes holds SQLite's lock on it
TEMPORARY = ".writing-"
CATALOG = "catalog"  # the last number of each kind
#: Digests stand before the body, whose pages are then read only for the body.
SCHEMA = (
    "CREATE TABLE records (kind TEXT NOT NULL, number INTEGER NOT NULL, head BLOB NOT "
    "NULL, head_digest BLOB NOT NULL, body_digest BLOB NOT NULL, body BLOB NOT NULL, "
    "PRIMARY KEY (kind, number))"
)
SETTINGS = ("trusted_schema = OFF", "cell_size_check = ON", "journal_mode = WAL")
SETTINGS += ("synchronous = FULL", "secure_delete = OFF")
SETTINGS += (f"journal_size_limit = {64 * 2**20}",)
#: Seconds to wait for a moment in which another process tidies up. A choice.
PATIENCE = 10.0
OTHERWISE = "or bring what is there from before up to date by: sbi-active migrate"

#: One thread at a time reads or writes, and none while the process forks.
_GUARD = threading.RLock()
_STORES: weakref.WeakSet[Store] = weakref.WeakSet()


class Store:
    """A file of records in a folder. Any number of processes read, and one writes.

    Who reads has the file open for a look alone; who writes, until it is closed.

    Args:
        folder: Folder that has or gets the file.
        what: Name of the store in errors, "bank" or "campaign".
        make: Make the file where there is none.

    Attributes:
        folder: Folder of the file.
        path: The file.

    Raises:
        ValueError: If there is none and none is to be made, the folder holds anything
            else, or a store of another format.
        CorruptSegmentError: Here and wherever records are read, if the file does not
            hold what was written.
    """

    def __init__(self, folder: Path, what: str = "bank", *, make: bool = False) -> None:
        self.folder, self.path, self._what = folder, folder / NAME, what
        self._connection: Any = None
        self._lock: Any = None
        self._catalog: dict[str, int] | None = None  # in a transaction
        with _GUARD:
            _STORES.add(self)
        if make and not os.path.lexists(self.path):
            try:
                self._make()
            except OSError:  # unless somebody was faster, and tidied up
                if not self.path.exists():
                    raise
        with self.reading():
            pass

    def __del__(self) -> None:
        with suppress(Exception):
            self.close()

    @property
    def held(self) -> bool:
        """Whether this object has the right to write, in this process."""
        return self._lock is not None

    @contextmanager
    def reading(self) -> Iterator[Any]:
        """Yield the connection for a look at one state, in this thread alone.

        Raises:
            CorruptSegmentError: If the file is damaged, or anything fails while its
                content is made sense of in the block.
            LockedError: If another process holds it for longer than it takes to read.
            OSError: If the disk is full or cannot be read.
        """
        with _GUARD:
            opens, keeps = self._connection is None, False
            try:
                if opens:
                    self._open()
                with sensible(self.path):
                    yield self._connection
                keeps = self.held
            finally:
                if opens and not keeps:
                    self._drop("_connection")

    @contextmanager
    def writing(self) -> Iterator[None]:
        """Write all that is put in the block, or nothing; on the disk at its end.

        Raises:
            LockedError: If somebody else has the right to write.
            OSError: If the disk is full or cannot be written.
        """
        with _GUARD:
            self.acquire()
            with self.reading() as connection:
                is_left = self._state() == self._left
                whole(self.path, is_left, "another file; nothing was written to it now")
                connection.execute("BEGIN IMMEDIATE")
                try:
                    before = self._catalog = self.catalog
                    yield
                    if self._catalog != before:
                        self.put(CATALOG, 0, self._catalog)
                    connection.commit()
                finally:
                    self._catalog = None
                    connection.rollback()  # of what was not committed
                self._left = self._state()

    def acquire(self) -> None:
        """Take the right to write, which ends with :meth:`close` or the process.

        Raises:
            LockedError: If another writer, in this process or another, has it.
            OSError: If the folder cannot be written.
        """
        with _GUARD, sensible(self.folder / LOCK):
            if self.held:
                return
            self._lock = _connected(self.folder / LOCK, "rwc", timeout=0.1)
            try:
                self._lock.execute("PRAGMA journal_mode = MEMORY")  # nothing is written
                self._lock.execute("BEGIN EXCLUSIVE")
            except BaseException:
                self._drop("_lock")
                raise
            for left in self.folder.glob(f"{TEMPORARY}*{NAME}*"):  # by the killed
                left.unlink(missing_ok=True)

    def close(self) -> None:
        """Let others write. The next call opens the file again."""
        with _GUARD:
            if self._connection is not None:
                with suppress(sqlite3.Error):  # a full disk must not keep the lock
                    self._connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
            self._drop("_connection", "_lock")

    def get(self, kind: str, number: int = 0, *, part: str = "head") -> bytes | None:
        """Return the head or the body of a record; None if there is none."""
        read = f"SELECT {part}, {part}_digest FROM records WHERE kind = ? AND number ="
        with self.reading() as connection:
            found = connection.execute(f"{read} ?", (kind, number)).fetchone()
            if found is None:
                listed = kind == CATALOG or number <= self.catalog.get(kind, -1)
                whole(self.path, not listed, f"no {kind!r} {number}: a gap")
                return None
            same = found[1] == _digest(self._id, part, kind, number, found[0])
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
        if self._catalog is not None:  # as it will be written
            return self._catalog
        found = self.json(CATALOG) or {}
        own = all(type(number) is int for number in found.values())
        whole(self.path, own, "a catalog that none writes")
        return found

    def length(self, series: str) -> int:
        """Return the number of records of a series."""
        return self.catalog.get(series, 0)

    def seal(self, *kinds: str) -> str:
        """Return a text that changes with the last record of each of some kinds."""
        read = "SELECT max(number), head_digest FROM records WHERE kind = ?"
        with self.reading() as connection:
            last = [connection.execute(read, (k,)).fetchone() for k in kinds]
        return hashlib.sha256(repr(last).encode()).hexdigest()

    def put(self, kind: str, number: int, head: Any, body: Any = b"") -> None:
        """Write a record in place of another; for use in :meth:`writing`.

        Args:
            kind: Kind of the record.
            number: Number of the record; 0 of one that is no series.
            head: Bytes, or JSON data.
            body: Bytes.
        """
        if kind != CATALOG and number > self.catalog.get(kind, -1):
            self._catalog = {**self.catalog, kind: number}
        _insert(self._connection, self._id, kind, number, head, body)

    def append(self, series: str, head: Any, body: Any = b"") -> int:
        """Write the next record of a series, in :meth:`writing`; return its number."""
        number = self.length(series) + 1
        self.put(series, number, head, body)
        return number

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
                    self.get(kind, number, part="body")

    def _make(self) -> None:
        """Make the file in a folder of its own, which is made where there is none."""
        folder, own = self.folder, (".", NAME, LOCK)  # of writers that were killed
        folder.mkdir(parents=True, exist_ok=True)
        other = sorted(p.name for p in folder.iterdir() if not p.name.startswith(own))
        expected, got = f"an empty folder for a {self._what}", f"{folder} with {other}"
        require(not other, expected, got, f"choose another folder, {OTHERWISE}")
        fresh, name = folder / f"{TEMPORARY}{os.getpid()}-{NAME}", secrets.randbits(31)
        fresh.unlink(missing_ok=True)
        made = sqlite3.connect(fresh, isolation_level=None)
        with sensible(fresh), closing(made):
            for setting in (f"user_version = {FORMAT}", f"application_id = {name}"):
                made.execute(f"PRAGMA {setting}")
            made.execute("PRAGMA journal_mode = WAL")
            made.execute(SCHEMA)
            _insert(made, name, CATALOG, 0, {}, b"")
        if not self.path.exists():  # nobody was faster
            os.replace(fresh, self.path)
            synchronize(folder)

    def _open(self) -> None:
        """Open the file, whose table must be that of a store."""
        path, expected, got = self.path, f"a {self._what}", f"no {self.path}"
        make = "give simulator= or directory=, or run sbi-active init, to make one"
        advice = f"{make}, {OTHERWISE}"
        require(os.path.lexists(path), expected, got, advice)
        # Where no notes of a reader can be written, or would be another user's and keep
        # the owner from writing, the file is read as it is.
        is_still = not all(os.access(p, os.W_OK) for p in (path, path.parent))
        is_still &= not path.with_name(f"{NAME}-wal").exists()
        mode = "ro&immutable=1" if is_still else "rw"
        self._connection = _connected(path, mode, timeout=PATIENCE)
        whole(path, path.stat().st_size > 0, "an empty file")
        execute = self._connection.execute
        with sensible(path):
            for setting in SETTINGS:
                execute(f"PRAGMA {setting}")
            execute("BEGIN")
            form = execute("PRAGMA user_version").fetchone()[0]
            self._id = execute("PRAGMA application_id").fetchone()[0]
            tables = execute("SELECT sql FROM sqlite_master").fetchall()
            if self.held:
                execute("COMMIT")
        expected, got = f"{expected} of format {FORMAT}", f"{form} in {path}"
        require(form == FORMAT, expected, got, "use the release that wrote it")
        is_own = tables == [(SCHEMA,), (None,)]  # the table, and the index of its key
        whole(path, is_own, "tables that are not those of a store")
        self._left = self._state()

    def _state(self) -> Any:
        """Return a value that changes if the file is another one, or is changed."""
        state = self.path.stat() if self.path.exists() else None
        return state and (state.st_ino, state.st_size, state.st_mtime_ns)

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
        try:
            mode_of = file.lstat().st_mode
        except FileNotFoundError:
            continue  # asked once: another process may begin it meanwhile
        is_plain = stat.S_ISREG(mode_of) and end != "-journal"
        reason = f"{file.name}, a link, no file, or a journal, which none leaves"
        whole(path, is_plain, reason)
    place = f"file:{quote(str(path.absolute()))}?mode={mode}"
    how: Any = {"isolation_level": None, "check_same_thread": False}
    return sqlite3.connect(place, uri=True, timeout=timeout, **how)


def _insert(at: Any, name: int, kind: str, number: int, head: Any, body: Any) -> None:
    """Write a record with its digests, in a store of a name."""
    if isinstance(head, dict):
        head = json.dumps(head, allow_nan=False).encode()
    parts = {"head": head, "body": body}
    digests = [_digest(name, part, kind, number, c) for part, c in parts.items()]
    row = (kind, number, head, *digests, body)
    at.execute("INSERT OR REPLACE INTO records VALUES (?, ?, ?, ?, ?, ?)", row)


def _digest(name: int, part: str, kind: str, number: int, content: bytes) -> bytes:
    """Return the checksum of a part of a record, in a store of a name."""
    digest = hashlib.sha256(f"{name} {part} {kind} {number} ".encode())
    digest.update(content)
    return digest.digest()


def _before_fork() -> None:
    """Close connections, which a child must not have, once they are not in use."""
    _GUARD.acquire()
    for store in _STORES:
        store._drop("_connection")


def _in_child() -> None:
    """Give back what a child has no right to: that of its parent to write."""
    for store in _STORES:
        store._drop("_lock")
    _GUARD.release()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=_before_fork, after_in_parent=_GUARD.release)
    os.register_at_fork(after_in_child=_in_child)

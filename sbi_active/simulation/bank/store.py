"""One file of SQLite for banks and campaigns: sealed records, and one writer at a time.

A record has a kind and a number, and a SHA-256 over these, its content and the file's
own name, so that bytes that were changed, exchanged or come from elsewhere are noticed:
SQLite itself has checksums of its log alone. Records of a series are numbered from 1
and counted, so that lost ones are noticed too.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import sqlite3
import threading
import weakref
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

from sbi_active.simulation.bank.damage import (
    CorruptSegmentError,
    LockedError,
    is_count,
    parsed,
    require,
)
from sbi_active.simulation.bank.files import TEMPORARY, keep_aside, synchronize
from sbi_active.simulation.bank.sqlite import (
    LOCK,
    NAME,
    OBJECTS,
    TABLES,
    connected,
    created,
    explained,
    finished,
    made,
    opened,
)

_OPEN: weakref.WeakSet[Store] = weakref.WeakSet()


class Store:
    """A file of records in a folder. Any number of processes read, and one writes.

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
        self._guard = threading.RLock()
        self._connection: sqlite3.Connection | None = None
        self._lock: sqlite3.Connection | None = None
        self._signature: tuple[int, ...] = ()
        self._depth, self._is_alone = 0, False
        _OPEN.add(self)
        if make and not self.path.exists():
            made(folder, what)
        with self.reading():
            pass

    def __del__(self) -> None:
        with suppress(Exception):
            self.close()

    @property
    def held(self) -> bool:
        """Whether this object has the right to write, in this process."""
        return self._lock is not None

    @property
    def generation(self) -> int:
        """Another number where the file was replaced, as by a repair."""
        return self._signature[0]

    @property
    def num_bytes(self) -> int:
        """Size on the disk."""
        files = (self.path.with_name(NAME + suffix) for suffix in ("", "-wal"))
        return sum(file.stat().st_size for file in files if file.exists())

    @contextmanager
    def reading(self) -> Iterator[sqlite3.Connection]:
        """Yield the connection, in this thread alone; its errors become this library's.

        Raises:
            CorruptSegmentError: If SQLite finds the file damaged.
            LockedError: If another process holds it for longer than it takes to read.
            OSError: If the disk is full or cannot be read or written.
        """
        with self._guard:
            try:
                is_same = self.held or self._found()[:1] == self._signature[:1]
                if self._connection is None or not is_same:
                    self._open()
                assert self._connection is not None
                self._depth += 1
                try:
                    yield self._connection
                finally:
                    self._depth -= 1
                if self._is_alone and not self._depth:
                    self._disconnect()
            except (sqlite3.Error, UnicodeDecodeError) as error:  # it quotes the file
                if "locked" in str(error):
                    raise LockedError(self.folder, *self._holder()) from error
                raise explained(error, self.path, self._what) from error

    def get(self, table: str, kind: str, number: int = 0) -> bytes | None:
        """Return the content of a record; None if there is none."""
        with self.reading() as connection:
            found = connection.execute(
                f"SELECT content, digest FROM {table} WHERE kind = ? AND number = ?",
                (kind, number),
            ).fetchone()
        where = f"{table} {kind!r} {number}"
        if found is None:  # or not found, as a page is damaged
            wrong = self._structure(table) if table == OBJECTS else []
            require(self.path, not wrong, f"no {where} ({wrong})")
            return None
        same = self._is_whole(table, (kind, number, *found))
        require(self.path, same, f"{where} with another checksum")
        return found[0]

    def size(self, table: str, kind: str, number: int = 0) -> int | None:
        """Return the bytes of a record without reading it; None if there is none."""
        return self._look("length(content)", table, kind, number)

    def remains(self, table: str, kind: str, number: int) -> str:
        """Return the rest of a damaged record, for people."""
        try:
            left = self._look("content", table, kind, number)
            return left.decode(errors="replace")
        except Exception:  # whatever is there, or nothing
            return ""

    def _look(self, what: str, table: str, kind: str, number: int) -> Any:
        with self.reading() as connection:
            found = connection.execute(
                f"SELECT {what} FROM {table} WHERE kind = ? AND number = ?",
                (kind, number),
            ).fetchone()
        return None if found is None else found[0]

    def text(self, kind: str, number: int = 0) -> dict[str, Any] | None:
        """Return an object that was kept as JSON."""
        content = self.get(OBJECTS, kind, number)
        return None if content is None else parsed(self.path, content)

    def length(self, table: str, series: str) -> int:
        """Return the number of records of a series."""
        found = self.text(f"{table} of {series}")
        count: Any = 0 if found is None else found.get("length")
        require(self.path, is_count(count), f"{count!r} as length of {series!r}")
        return count

    def kinds(self) -> list[str]:
        """Return the kinds of the objects."""
        with self.reading() as connection:
            rows = connection.execute("SELECT kind FROM objects ORDER BY kind")
            return [str(row[0]) for row in rows]

    def put(self, table: str, kind: str, number: int, content: Any) -> None:
        """Write a record in place of another; for use in :meth:`writing`.

        Args:
            table: Name of the table.
            kind: Kind of the record.
            number: Number of the record.
            content: Bytes, or JSON data of an object.
        """
        if isinstance(content, dict):
            content = json.dumps(content, allow_nan=False).encode()
        digest = self._digest(table, kind, number, content)
        assert self._connection is not None
        self._connection.execute(
            f"INSERT INTO {table} VALUES (?, ?, ?, ?) ON CONFLICT DO UPDATE "
            "SET content = excluded.content, digest = excluded.digest",
            (kind, number, content, digest),
        )

    @contextmanager
    def writing(self, series: tuple[str, str] | None = None) -> Iterator[int]:
        """Write all that is put in the block, or nothing; on the disk at its end.

        Args:
            series: Table and name of a series that gets one more record; its number is
                yielded.

        Raises:
            LockedError: If somebody else has the right to write.
            OSError: If the disk is full or cannot be written.
        """
        with self._guard:
            self.acquire()
            with self.reading() as connection:
                is_inner = connection.in_transaction  # of one that writes more
                if not is_inner:
                    same = self._found() == self._signature
                    reason = "another file; nothing was written to it now"
                    require(self.path, same, reason)
                    connection.execute("BEGIN IMMEDIATE")
                try:
                    number = 0 if series is None else self.length(*series) + 1
                    yield number
                    if series is not None:
                        key = "{} of {}".format(*series)
                        self.put(OBJECTS, key, 0, {"length": number})
                    if not is_inner:
                        connection.execute("COMMIT")
                        self._signature = self._found()
                finally:
                    if not is_inner and connection.in_transaction:
                        connection.execute("ROLLBACK")

    def delete(self, table: str, kind: str, *, first: int = 0) -> None:
        """Remove records from a number on; for use in :meth:`writing`."""
        assert self._connection is not None
        self._connection.execute(
            f"DELETE FROM {table} WHERE kind = ? AND number >= ?", (kind, first)
        )

    def acquire(self) -> None:
        """Take the right to write, which ends with :meth:`close` or the process.

        Raises:
            LockedError: If another writer, in this process or another, has it.
        """
        with self._guard, self.reading():
            if self.held:
                return
            lock = connected(self.folder / LOCK, "rwc", timeout=0.1)
            try:
                lock.execute("PRAGMA journal_mode = MEMORY")  # nothing is written
                lock.execute("BEGIN EXCLUSIVE")
                self._lock = lock
                if self._found() != self._signature:  # nothing old may be remembered
                    self._open()
                for left in self.folder.glob(f"{TEMPORARY}*{NAME}*"):  # by the killed
                    left.unlink(missing_ok=True)
                assert self._connection is not None
                self._connection.execute("PRAGMA synchronous = OFF")
                # Only a note; and a file that cannot be written to may be repaired.
                with suppress(CorruptSegmentError), self.writing():
                    holder = {"pid": os.getpid(), "host": platform.node()}
                    self.put(OBJECTS, "writer", 0, holder)
                self._connection.execute("PRAGMA synchronous = FULL")
            except BaseException:
                self._lock = None
                lock.close()
                raise

    def close(self) -> None:
        """Let others write. The next call opens the file again."""
        with self._guard:
            lock, self._lock = self._lock, None
            if lock is not None and self._connection is not None:
                with suppress(sqlite3.Error):  # a full disk must not keep the lock
                    self._connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
            self._disconnect()
            if lock is not None:
                lock.close()

    def _disconnect(self) -> None:
        if self._connection is not None:
            self._connection.close()
        self._connection, self._signature = None, ()

    def problems(self) -> list[str]:
        """Return the problems of the file and its objects, one line each."""
        wrong = self._structure("9")  # as many as are listed
        for kind in [] if wrong else self.kinds():
            try:
                self.get(OBJECTS, kind)
            except CorruptSegmentError as error:
                wrong.append(error.reason)
        return wrong

    def _structure(self, what: str) -> list[str]:
        """Return the problems that SQLite finds in the file, or in a table of it."""
        try:
            with self.reading() as connection:
                check = f"PRAGMA integrity_check({what})"
                found = connection.execute(check).fetchall()
        except CorruptSegmentError as error:
            return [error.reason]
        return [str(row[0]) for row in found if row[0] != "ok"]

    def salvage(self) -> None:
        """Write the file anew from the records that are whole.

        The former file is kept, its name ending in ".damaged".
        """
        self.acquire()
        fresh = self.folder / f"{TEMPORARY}{os.getpid()}-{NAME}"
        lengths: dict[tuple[str, str], int] = {}
        copy = created(fresh, self._id)
        with self.reading() as connection:
            for table in TABLES:
                for order in ("", " DESC"):  # from both ends up to what is damaged
                    with suppress(sqlite3.Error):
                        rows = connection.execute(
                            f"SELECT kind, number, content, digest FROM {table} "
                            f"NOT INDEXED ORDER BY rowid{order}"
                        )
                        for row in filter(partial(self._is_whole, table), rows):
                            key = table, row[0].partition("/")[0]
                            lengths[key] = max(lengths.get(key, 0), row[1])
                            insert = f"INSERT OR IGNORE INTO {table} VALUES (?,?,?,?)"
                            copy.execute(insert, row)
        finished(copy, fresh)
        self.close()
        keep_aside(self.path)
        os.replace(fresh, self.path)
        synchronize(self.folder)
        for (table, series), length in lengths.items():
            if table != OBJECTS and self.length(table, series) < length:
                with self.writing():
                    self.put(OBJECTS, f"{table} of {series}", 0, {"length": length})

    def _is_whole(self, table: str, row: tuple[Any, ...]) -> bool:
        kind, number, content, digest = row
        if (type(kind), type(number), type(content)) != (str, int, bytes):
            return False
        return digest == self._digest(table, kind, number, content)

    def _digest(self, table: str, kind: str, number: int, content: Any) -> bytes:
        digest = hashlib.sha256(f"{self._id} {table} {kind} {number} ".encode())
        digest.update(content)
        return digest.digest()

    def _found(self) -> tuple[int, ...]:
        """Return a value that changes if the file is another one, or is changed."""
        with suppress(OSError):
            state = self.path.stat()
            return state.st_ino, state.st_size, state.st_mtime_ns
        return ()

    def _open(self) -> None:
        self._disconnect()
        self._connection, self._is_alone = opened(self.path, self._what)
        name = self._connection.execute("PRAGMA application_id")
        self._id = name.fetchone()[0]
        self._signature = self._found()

    def _holder(self) -> tuple[int | None, str]:
        with suppress(Exception):  # it locked a moment ago, or the file is damaged
            found = self.text("writer") or {}
            return int(found["pid"]), str(found["host"])
        return None, platform.node()


def _before_fork() -> None:
    """Close connections, which a child must not have, once they are not in use."""
    for store in [*_OPEN]:
        store._guard.acquire()
        store._disconnect()


def _after_fork(*, child: bool) -> None:
    for store in [*_OPEN]:
        if child and store._lock is not None:  # a child has no right of its parent's
            store._lock.close()
            store._lock = None
        with suppress(RuntimeError):  # made meanwhile
            store._guard.release()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(
        before=_before_fork,
        after_in_parent=partial(_after_fork, child=False),
        after_in_child=partial(_after_fork, child=True),
    )

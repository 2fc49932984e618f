"""A store of sealed records, with one writer at a time: of banks and of campaigns.

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
import platform
import sqlite3
import threading
import weakref
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from sbi_active.simulation.bank.sqlite import (
    CATALOG,
    INSERT,
    LOCK,
    NAME,
    TEMPORARY,
    CorruptSegmentError,
    LockedError,
    connected,
    digest_of,
    explained,
    keep_aside,
    make_store,
    opened,
    require,
    sealed,
    sensible,
    synchronize,
    written,
)

MOST_LISTED = 1_000  # problems; a catalog may be made up

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
            make_store(folder, what)
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

    def get(self, kind: str, number: int = 0) -> bytes | None:
        """Return the head of a record; None if there is none."""
        return self._read("head", kind, number)

    def body(self, kind: str, number: int = 0) -> bytes:
        """Return the body of a record that is there."""
        content = self._read("body", kind, number)
        require(self.path, content is not None, f"no {kind!r} {number}")
        return content or b""

    def _read(self, part: str, kind: str, number: int) -> bytes | None:
        with self.reading() as connection:
            found = connection.execute(
                f"SELECT {part}, {part}_digest FROM records WHERE kind = ? AND number "
                "= ?",
                (kind, number),
            ).fetchone()
            if found is None:
                listed = kind == CATALOG or number <= self.catalog.get(kind, -1)
                require(self.path, not listed, f"no {kind!r} {number}: a gap")
                return None
            same = found[1] == digest_of(self._id, part, kind, number, found[0])
        require(self.path, same, f"{kind!r} {number} with another checksum")
        return found[0]

    def remains(self, kind: str, number: int) -> str:
        """Return what is left of the head of a damaged record, for people."""
        with suppress(Exception), self.reading() as connection:
            read = "SELECT head FROM records WHERE kind = ? AND number = ?"
            found = connection.execute(read, (kind, number)).fetchone()
            return found[0].decode(errors="replace")
        return ""

    def json(self, kind: str, number: int = 0) -> dict[str, Any] | None:
        """Return the JSON object in a record; None if there is none."""
        content = self.get(kind, number)
        with sensible(self.path):
            return None if content is None else dict(json.loads(content))

    @property
    def catalog(self) -> dict[str, int]:
        """The last number of each kind."""
        found = self.json(CATALOG) or {}
        own = all(type(number) is int for number in found.values())
        require(self.path, own, "a catalog that none writes")
        return found

    def length(self, series: str) -> int:
        """Return the number of records of a series."""
        return self.catalog.get(series, 0)

    def seal(self, *kinds: str) -> str:
        """Return a text that changes with the last record of each of some kinds."""
        read = "SELECT max(number), head_digest FROM records WHERE kind = ?"
        with self.reading() as connection:
            last = [connection.execute(read, (kind,)).fetchone() for kind in kinds]
        return hashlib.sha256(repr(last).encode()).hexdigest()

    def put(self, kind: str, number: int, head: Any, body: Any = b"") -> None:
        """Write a record in place of another; for use in :meth:`writing`.

        Args:
            kind: Kind of the record.
            number: Number of the record; 0 of one that is no series.
            head: Bytes, or JSON data.
            body: Bytes.
        """
        assert self._connection is not None
        catalog, records = self.catalog, [sealed(self._id, kind, number, head, body)]
        if kind != CATALOG and number > catalog.get(kind, -1):
            records.append(sealed(self._id, CATALOG, 0, {**catalog, kind: number}))
        self._connection.executemany(INSERT.format("REPLACE"), records)

    def append(self, series: str, head: Any, body: Any = b"") -> int:
        """Write the next record of a series, in :meth:`writing`; return its number."""
        number = self.length(series) + 1
        self.put(series, number, head, body)
        return number

    def delete(self, *kinds: str) -> None:
        """Remove records; for use in :meth:`writing`."""
        assert self._connection is not None
        for kind in kinds:
            self._connection.execute("DELETE FROM records WHERE kind = ?", (kind,))
        kept = {k: n for k, n in self.catalog.items() if k not in kinds}
        catalog = sealed(self._id, CATALOG, 0, kept)
        self._connection.execute(INSERT.format("REPLACE"), catalog)

    @contextmanager
    def writing(self) -> Iterator[None]:
        """Write all that is put in the block, or nothing; on the disk at its end.

        Raises:
            LockedError: If somebody else has the right to write.
            OSError: If the disk is full or cannot be written.
        """
        with self._guard:
            self.acquire()
            with self.reading() as connection:
                if connection.in_transaction:  # of one that writes more
                    yield
                    return
                same = self._found() == self._signature
                require(self.path, same, "another file; nothing was written to it now")
                connection.execute("BEGIN IMMEDIATE")
                try:
                    yield
                    connection.execute("COMMIT")
                    self._signature = self._found()
                finally:
                    if connection.in_transaction:
                        connection.execute("ROLLBACK")

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
                    self.put("writer", 0, {"pid": os.getpid(), "host": platform.node()})
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

    def problems(self) -> list[str]:
        """Return the problems of the file and its records, one line each."""
        try:
            with self.reading() as connection:
                found = connection.execute("PRAGMA integrity_check(9)").fetchall()
                catalog = self.catalog
        except CorruptSegmentError as error:
            return [error.reason]
        wrong = [str(row[0]) for row in found if row[0] != "ok"]
        for kind, last in [] if wrong else catalog.items():
            for number in range(min(last, 1), last + 1):
                try:
                    self.get(kind, number)
                    self.body(kind, number)
                except CorruptSegmentError as error:
                    wrong.append(error.reason)
                    if len(wrong) > MOST_LISTED:
                        return wrong
        return wrong

    def salvage(self) -> None:
        """Write the file anew from the records that are whole, and number them anew.

        The former file is kept, its name ending in ".damaged".
        """
        self.acquire()
        with self.reading() as connection:
            whole: dict[int, tuple[str, int]] = {}
            for order in ("", " DESC"):  # from both ends up to what is damaged
                with suppress(sqlite3.Error):
                    for row in connection.execute(
                        "SELECT rowid, kind, number, head, head_digest, body_digest, "
                        f"body FROM records NOT INDEXED ORDER BY rowid{order}"
                    ):
                        if row[1:] == sealed(self._id, row[1], row[2], row[3], row[6]):
                            whole[row[0]] = row[1:3]
            catalog: dict[str, int] = {}

            def renumbered() -> Iterator[tuple[Any, ...]]:
                for rowid, (kind, number) in sorted(whole.items(), key=lambda w: w[1]):
                    read = "SELECT head, body FROM records WHERE rowid = ?"
                    content = connection.execute(read, (rowid,)).fetchone()
                    number = number and catalog.get(kind, 0) + 1
                    if kind != CATALOG:
                        catalog[kind] = number
                        yield sealed(self._id, kind, number, content[0], content[1])
                yield sealed(self._id, CATALOG, 0, catalog)

            fresh = written(self.folder, self._id, renumbered())
        self.close()
        keep_aside(self.path)
        os.replace(fresh, self.path)
        synchronize(self.folder)

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

    def _disconnect(self) -> None:
        if self._connection is not None:
            self._connection.close()
        self._connection, self._signature = None, ()

    def _holder(self) -> tuple[int | None, str]:
        with suppress(Exception):  # it locked a moment ago, or the file is damaged
            found = self.json("writer") or {}
            return int(found["pid"]), str(found["host"])
        return None, platform.node()


def _before_fork() -> None:
    """Close connections, which a child must not have, once they are not in use."""
    for store in [*_OPEN]:
        store._guard.acquire()
        store._disconnect()


def _after_fork(*, child: bool = False) -> None:
    for store in [*_OPEN]:
        if child and store._lock is not None:  # a child has no right of its parent's
            store._lock.close()
            store._lock = None
        with suppress(RuntimeError):  # made meanwhile
            store._guard.release()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(
        before=_before_fork,
        after_in_parent=_after_fork,
        after_in_child=lambda: _after_fork(child=True),
    )

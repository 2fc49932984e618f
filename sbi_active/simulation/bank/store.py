"""A store of sealed records, with one writer at a time: of banks and of campaigns.

A record has a kind, a number, a head and a body, which is read apart: that of rows is
what they measure. Records of a series are numbered from 1, and a catalog says which
there are. Checksums cover kind, number and the file's own name, so that bytes that were
changed, exchanged, lost or come from elsewhere are noticed: SQLite itself has checksums
of its log alone.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import os
import platform
import shutil
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
    make_store,
    opened,
    require,
    sealed,
    sensible,
    synchronize,
    written,
)

MOST_LISTED = 1_000  # records of a kind; a catalog may be made up

_STORES: weakref.WeakSet[Store] = weakref.WeakSet()


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
        self._guard, self._depth = threading.RLock(), 0
        self._connection: Any = None
        self._is_alone = False
        self._lock: sqlite3.Connection | None = None
        self._signature: tuple[int, ...] = ()
        _STORES.add(self)
        if make and not os.path.lexists(self.path):
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
            is_outer, self._depth = not self._depth, self._depth + 1
            try:
                is_same = self.held or self._found()[:1] == self._signature[:1]
                if is_outer and not is_same:
                    self._disconnect()
                if self._connection is None:
                    self._connection, self._is_alone = opened(self.path, self._what)
                    name = self._connection.execute("PRAGMA application_id")
                    self._id, self._signature = name.fetchone()[0], self._found()
                if is_outer and not self.held:
                    self._connection.execute("BEGIN")  # sees one state of the file
                yield self._connection
            except (sqlite3.Error, UnicodeDecodeError) as error:  # it quotes the file
                if "locked" in str(error):
                    raise LockedError(self.folder, *self._holder()) from error
                raise explained(error, self.path, self._what) from error
            finally:
                self._depth -= 1
                if is_outer and not self.held and self._connection is not None:
                    self._connection.rollback()
                    if self._is_alone:
                        self._disconnect()

    def get(self, kind: str, number: int = 0, *, part: str = "head") -> bytes | None:
        """Return the head or the body of a record; None if there is none."""
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

    def body(self, kind: str, number: int = 0) -> bytes:
        """Return the body of a record that is there."""
        content = self.get(kind, number, part="body")
        require(self.path, content is not None, f"no {kind!r} {number}")
        return content or b""

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
        if kind != CATALOG and number > (catalog := self.catalog).get(kind, -1):
            self.put(CATALOG, 0, {**catalog, kind: number})
        self._connection.execute(INSERT, sealed(self._id, kind, number, head, body))

    def append(self, series: str, head: Any, body: Any = b"") -> int:
        """Write the next record of a series, in :meth:`writing`; return its number."""
        number = self.length(series) + 1
        self.put(series, number, head, body)
        return number

    def delete(self, kind: str) -> None:
        """Remove the records of a kind; for use in :meth:`writing`."""
        self._connection.execute("DELETE FROM records WHERE kind = ?", (kind,))
        kept = {name: last for name, last in self.catalog.items() if name != kind}
        self.put(CATALOG, 0, kept)

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
                    connection.commit()
                    self._signature = self._found()
                finally:
                    connection.rollback()  # of what was not committed

    def acquire(self) -> None:
        """Take the right to write, which ends with :meth:`close` or the process.

        Raises:
            LockedError: If another writer, in this process or another, has it.
            OSError: If the folder cannot be written.
        """
        with self._guard, self.reading():
            if self.held:
                return
            lock = connected(self.folder / LOCK, "rwc", timeout=0.1)
            try:
                lock.execute("PRAGMA journal_mode = MEMORY")  # nothing is written
                lock.execute("BEGIN EXCLUSIVE")
                self._lock = lock
                self._disconnect()  # nothing old may be remembered
                for left in self.folder.glob(f"{TEMPORARY}*{NAME}*"):  # by the killed
                    left.unlink(missing_ok=True)
                # Only a note; and a file that cannot be written to may be repaired.
                with suppress(CorruptSegmentError), self.writing():
                    self.put("writer", 0, {"pid": os.getpid(), "host": platform.node()})
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
                wrong = [str(row[0]) for row in found if row[0] != "ok"]
                whole = self._whole(connection)
                for kind, last in self.catalog.items():
                    numbers = range(min(last, 1), last + 1)
                    lost = (n for n in numbers if (kind, n) not in whole)
                    some = itertools.islice(lost, MOST_LISTED)
                    wrong += [f"{kind!r} {n} changed or lost" for n in some]
        except CorruptSegmentError as error:
            return [error.reason]
        return wrong

    def _whole(self, connection: sqlite3.Connection) -> dict[tuple[str, int], int]:
        """Return where the records stand that are as they were written."""
        whole: dict[tuple[str, int], int] = {}
        for order in ("", "DESC"):  # from both ends up to what is damaged
            with suppress(sqlite3.Error):
                for found in connection.execute(
                    f"SELECT rowid, * FROM records NOT INDEXED ORDER BY rowid {order}"
                ):
                    rowid, kind, number, head, _, _, body = found
                    if found[1:] == sealed(self._id, kind, number, head, body):
                        whole[kind, number] = rowid
                return whole
        return whole

    def salvage(self) -> None:
        """Write the file anew from the records that are whole, and number them anew.

        The former file is kept, its name ending in ".damaged".
        """
        self.acquire()
        with self.reading() as connection:
            catalog: dict[str, int] = {}

            def renumbered() -> Iterator[tuple[Any, ...]]:
                for (kind, number), rowid in sorted(self._whole(connection).items()):
                    read = "SELECT head, body FROM records WHERE rowid = ?"
                    head, body = connection.execute(read, (rowid,)).fetchone()
                    if kind != CATALOG:
                        catalog[kind] = number and catalog.get(kind, 0) + 1
                        yield sealed(self._id, kind, catalog[kind], head, body)
                yield sealed(self._id, CATALOG, 0, catalog)

            fresh = written(self.folder, self._id, renumbered())
        self.close()
        names = (f"{NAME}.damaged" + f"-{n}" * (n > 1) for n in itertools.count(1))
        copies = (self.path.with_name(name) for name in names)
        copy = next(copy for copy in copies if not os.path.lexists(copy))
        shutil.copy2(self.path, copy)
        os.replace(fresh, self.path)
        synchronize(self.folder)

    def _found(self) -> tuple[int, ...]:
        """Return a value that changes if the file is another one, or is changed."""
        with suppress(OSError):
            state = self.path.stat()
            return state.st_ino, state.st_size, state.st_mtime_ns
        return ()

    def _holder(self) -> tuple[int | None, str]:
        with suppress(Exception):  # it locked a moment ago, or the file is damaged
            found = self.json("writer") or {}
            return int(found["pid"]), str(found["host"])
        return None, platform.node()

    def _disconnect(self) -> None:
        if self._connection is not None:
            self._connection.close()
        self._connection, self._signature = None, ()


def _before_fork() -> None:
    """Close connections, which a child must not have, once they are not in use."""
    for store in [*_STORES]:
        store._guard.acquire()
        store._disconnect()


def _after_fork(*, child: bool = False) -> None:
    for store in [*_STORES]:
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

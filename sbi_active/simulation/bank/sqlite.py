"""The file of a store, which may come from anybody: nothing in it is executed.

Its table is compared with that of a store before anything is read from it, no journal
is played back that none leaves, and no link is followed.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import platform
import secrets
import sqlite3
import stat
from collections.abc import Iterable, Iterator, Mapping
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any
from urllib.parse import quote

from sbi_active.messages import Explained

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
INSERT = "INSERT OR REPLACE INTO records VALUES (?, ?, ?, ?, ?, ?)"
#: Seconds to wait for a moment in which another process tidies up. A choice.
PATIENCE = 10.0
SETTINGS = (
    *("trusted_schema = OFF", "cell_size_check = ON", "journal_mode = WAL"),
    *("synchronous = FULL", "secure_delete = OFF"),
    f"journal_size_limit = {64 * 2**20}",
)
#: Words of SQLite's errors that say nothing against the file.
OF_THE_DISK = {
    "full": errno.ENOSPC,
    "readonly": errno.EROFS,
    "disk I/O": errno.EIO,
    "unable to open": errno.EACCES,
    "too big": errno.EFBIG,  # 1 GB
}


class CorruptSegmentError(Explained, OSError):
    """A file of a bank or campaign that does not hold what was written to it.

    Attributes:
        path: The file.
        reason: Text that says what is wrong with it.
    """

    code = "SA605"

    def __init__(self, path: Path, reason: str) -> None:
        self.path, self.reason = path, reason
        super().__init__(
            f"expected {path} as it was written; got {reason}; restore it from a copy, "
            "or give up what is damaged, which keeps a copy: by repair() of a bank "
            "that is opened with its simulator, or Campaign.load(..., repair=True)"
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


def require(path: Path, holds: bool, reason: str) -> None:
    """Raise if something does not hold of a file.

    Raises:
        CorruptSegmentError: If it does not hold, with the reason.
    """
    if not holds:
        raise CorruptSegmentError(path, reason)


@contextmanager
def sensible(path: Path) -> Iterator[None]:
    """Turn whatever fails while content is made sense of into damage of its file.

    Raises:
        CorruptSegmentError: If any error is raised that names no file.
    """
    try:
        yield
    except OSError:
        raise
    except Exception as error:  # what a crafted file leads to has no end
        text = f"content that leads to {type(error).__name__}: {str(error):.200}"
        raise CorruptSegmentError(path, text) from error


def is_locked(folder: Path) -> bool:
    """Return whether somebody has the right to write, without taking it.

    Args:
        folder: Folder of a store.
    """
    if not (folder / LOCK).exists():
        return False
    try:
        with closing(connected(folder / LOCK, "ro", timeout=0.0)) as lock:
            lock.execute("SELECT name FROM sqlite_master")
    except sqlite3.OperationalError as error:
        return "locked" in str(error)
    return False


def connected(path: Path, mode: str, *, timeout: float) -> sqlite3.Connection:
    """Return a connection that begins no transaction by itself.

    Args:
        path: The file.
        mode: Mode as SQLite names it, "rw" or "rwc".
        timeout: Seconds to wait for others.

    Raises:
        OSError: If the file is a link, which would lead elsewhere.
        CorruptSegmentError: If there is a journal, which SQLite would write back, here
            and to whatever else it names.
    """
    journal = path.with_name(f"{path.name}-journal")
    require(path, not os.path.lexists(journal), f"{journal.name}, which none leaves")
    for file in (path, *(path.with_name(path.name + end) for end in ("-wal", "-shm"))):
        if file.is_symlink():
            raise OSError(
                f"expected {file} as a file; got a link to {file.readlink()}; remove "
                "it, after a look at where the folder comes from"
            )
    return sqlite3.connect(
        f"file:{quote(str(path.absolute()))}?mode={mode}",
        uri=True,
        timeout=timeout,
        isolation_level=None,
        check_same_thread=False,
    )


def opened(path: Path, what: str) -> tuple[sqlite3.Connection, bool]:
    """Return a connection to a store, and whether it is for one look alone.

    This is the case if not even the notes of a reader can be written beside the file:
    it is then read as it is, and others have to wait.

    Raises:
        ValueError: If there is none, or one of another format.
        CorruptSegmentError: If the file is no store.
    """
    if not os.path.lexists(path):
        make = "make one by Campaign(..., directory=...)"
        make = "give simulator= to make one" if what == "bank" else make
        advice = _advice(path.parent, make)
        raise ValueError(f"expected a {what}; got no {path}; {advice}")
    if not path.is_symlink():  # which is said to be one
        found = path.stat()  # a pipe or a device would be waited for
        is_file = stat.S_ISREG(found.st_mode) and found.st_size > 0
        require(path, is_file, "no file, or an empty one")
    with suppress(sqlite3.OperationalError):
        return _checked(path, what, "rw"), False
    log = path.with_name(f"{NAME}-wal")
    if log.exists() and log.stat().st_size:
        return _checked(path, what, "rw", "locking_mode = EXCLUSIVE"), True
    return _checked(path, what, "ro&immutable=1"), True


def _checked(path: Path, what: str, mode: str, *first: str) -> sqlite3.Connection:
    """Return a connection to a file whose table is that of a store."""
    connection = connected(path, mode, timeout=PATIENCE)
    try:
        for setting in (*first, *SETTINGS):
            connection.execute(f"PRAGMA {setting}")
        form = connection.execute("PRAGMA user_version").fetchone()[0]
        if form != FORMAT:
            raise ValueError(
                f"expected a {what} of format {FORMAT}; got {form} in {path}; use the "
                "release of sbi-active that wrote it"
            )
        found = connection.execute("SELECT sql FROM sqlite_master").fetchall()
        own = found == [(SCHEMA,), (None,)]  # the table, and the index of its key
        require(path, own, "tables that are not those of a store")
    except BaseException:
        connection.close()
        raise
    return connection


def make_store(folder: Path, what: str) -> None:
    """Make a store in a folder of its own, which is made where there is none."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        own = (".", NAME, LOCK)  # of writers that were killed
        names = sorted(path.name for path in folder.iterdir())
        if other := [name for name in names if not name.startswith(own)]:
            raise ValueError(
                f"expected a {what} or an empty folder; got {folder} with "
                f"{other[0]!r}; {_advice(folder, 'choose another folder')}"
            )
        name = secrets.randbits(31)
        fresh = written(folder, name, [sealed(name, CATALOG, 0, {})])
        if not (folder / NAME).exists():  # nobody was faster
            os.replace(fresh, folder / NAME)
            synchronize(folder)
    except (OSError, sqlite3.Error) as error:
        raise explained(error, folder / NAME, what) from error


def written(folder: Path, name: int, records: Iterable[tuple[Any, ...]]) -> Path:
    """Return a new file with records, all of it on the disk."""
    path = folder / f"{TEMPORARY}{os.getpid()}-{NAME}"
    path.unlink(missing_ok=True)
    with closing(sqlite3.connect(path, isolation_level=None)) as connection:
        settings = f"user_version = {FORMAT}", f"application_id = {name}"
        for setting in ("journal_mode = WAL", *settings):
            connection.execute(f"PRAGMA {setting}")
        connection.execute("BEGIN IMMEDIATE")
        connection.execute(SCHEMA)
        connection.executemany(INSERT, records)
        connection.execute("COMMIT")
    return path


def sealed(
    name: int, kind: str, number: int, head: Any, body: Any = b""
) -> tuple[Any, ...]:
    """Return a record with its digests, in the order of the columns."""
    if isinstance(head, Mapping):
        head = json.dumps(head, allow_nan=False).encode()
    parts = {"head": head, "body": body}
    digests = (digest_of(name, part, kind, number, c) for part, c in parts.items())
    return (kind, number, head, *digests, body)


def digest_of(name: int, part: str, kind: str, number: int, content: Any) -> Any:
    """Return the checksum of a part of a record, in a store of a name."""
    if not isinstance(content, bytes | memoryview):  # as anybody can write there
        return None
    digest = hashlib.sha256(f"{name} {part} {kind} {number} ".encode())
    digest.update(content)
    return digest.digest()


def explained(error: Exception, path: Path, what: str) -> Exception:
    """Return an error of SQLite or of the disk as one of this library."""
    text = getattr(error, "strerror", None) or str(error)
    numbers = [number for words, number in OF_THE_DISK.items() if words in text]
    if not numbers and not isinstance(error, OSError):
        return CorruptSegmentError(path, f"what SQLite cannot read ({text})")
    return OSError(
        getattr(error, "errno", None) or numbers[0],
        f"expected to write to the {what}; got {text!r}; make room or choose a place "
        "that can be written, and run again: what was stored before is whole",
        str(path),
    )


def _advice(folder: Path, otherwise: str) -> str:
    """Return advice on a folder that has no store."""
    if any((folder / name).exists() for name in ("bank.json", "campaign.json")):
        return f"bring it up to date by: sbi-active migrate {folder}"
    return otherwise


def synchronize(folder: Path) -> None:
    """Make the names in a folder durable; file systems differ in whether they are."""
    if os.name == "posix":  # elsewhere a folder cannot be opened, nor needs it
        descriptor = os.open(folder, os.O_RDONLY)
        os.fsync(descriptor)
        os.close(descriptor)

"""Connections to a store's file, which may come from anybody: it is never executed.

SQLite is configured to refuse commands that a file may contain: tables are compared
with those of a store before anything is read from them, no journal is played back that
none leaves, and no link is followed.
"""

from __future__ import annotations

import errno
import os
import secrets
import sqlite3
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import quote

from sbi_active.simulation.bank.damage import (
    CorruptSegmentError,
    regular_size,
    require,
    require_no_link,
)
from sbi_active.simulation.bank.files import TEMPORARY, synchronize

NAME, FORMAT = "store.db", 2  # format 1 was folders of HDF5
LOCK = "store.lock"  # empty: who writes holds SQLite's lock on it
#: Rows of simulations; what was asked, told and decided; all that is kept once.
SEGMENTS, EVENTS, OBJECTS = TABLES = ("segments", "events", "objects")
SCHEMA = {
    table: f"CREATE TABLE {table} (kind TEXT NOT NULL, number INTEGER NOT NULL, "
    "content BLOB NOT NULL, digest BLOB NOT NULL, PRIMARY KEY (kind, number))"
    for table in TABLES
}
#: Seconds to wait for a moment in which another process tidies up. A choice.
PATIENCE = 10.0
SETTINGS = (
    "trusted_schema = OFF",
    "cell_size_check = ON",
    "journal_mode = WAL",
    "synchronous = FULL",
    "secure_delete = OFF",
    f"journal_size_limit = {64 * 2**20}",
)
#: Words of SQLite's errors that say nothing against the file.
OF_THE_DISK = {
    "full": errno.ENOSPC,
    "readonly": errno.EROFS,
    "disk I/O": errno.EIO,
    "unable to open": errno.EACCES,
}


def connected(path: Path, mode: str, *, timeout: float) -> sqlite3.Connection:
    """Return a connection that begins no transaction by itself.

    Args:
        path: The file.
        mode: Mode as SQLite names it, "rw" or "rwc".
        timeout: Seconds to wait for others.

    Raises:
        CorruptSegmentError: If there is a journal, which SQLite would write back, here
            and to whatever else it names.
    """
    journal = path.with_name(f"{path.name}-journal")
    require(path, not os.path.lexists(journal), f"{journal.name}, which none leaves")
    require_no_link(path)
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

    Args:
        path: The file.
        what: It is said to be in errors.

    Raises:
        ValueError: If there is none, or one of another format.
        CorruptSegmentError: If it is no store.
    """
    log = path.with_name(f"{NAME}-wal")
    for file in (path, log, path.with_name(f"{NAME}-shm")):
        require_no_link(file)
    try:
        size = regular_size(path)
    except (FileNotFoundError, NotADirectoryError) as error:
        make = "make one by Campaign(..., directory=...)"
        make = "give simulator= to make one" if what == "bank" else make
        raise ValueError(
            f"expected a {what}; got no {path}; {advice(path.parent, make)}"
        ) from error
    require(path, size > 0, "an empty file")
    has_log = log.exists() and log.stat().st_size
    last = ("rw", "locking_mode = EXCLUSIVE") if has_log else ("ro&immutable=1", "")
    for mode, setting in (("rw", ""), ("ro", ""), last):
        connection = connected(path, mode, timeout=PATIENCE)
        try:
            _check(connection, path, what, (setting, *SETTINGS))
        except sqlite3.OperationalError:
            connection.close()
            if (mode, setting) == last:
                raise
        except BaseException:
            connection.close()
            raise
        else:
            return connection, (mode, setting) == last
    raise AssertionError


def _check(
    connection: sqlite3.Connection, path: Path, what: str, settings: Sequence[str]
) -> None:
    for setting in filter(None, settings):
        connection.execute(f"PRAGMA {setting}")
    found = connection.execute("SELECT name, sql FROM sqlite_master").fetchall()
    plain = {(name, sql) for name, sql in found if sql is not None}
    own = plain == {*SCHEMA.items()} and len(found) == 2 * len(SCHEMA)
    require(path, own, "tables that are not those of a store")
    form = connection.execute("PRAGMA user_version").fetchone()[0]
    if form != FORMAT:
        raise ValueError(
            f"expected a {what} of format {FORMAT}; got {form} in {path}; use the "
            "release of sbi-active that wrote it"
        )


def is_locked(folder: Path) -> bool:
    """Return whether somebody has the right to write, without taking it.

    Args:
        folder: Folder of a store.
    """
    if not (folder / LOCK).exists():
        return False
    lock = connected(folder / LOCK, "ro", timeout=0.0)
    try:
        lock.execute("SELECT name FROM sqlite_master")
    except sqlite3.OperationalError as error:
        return "locked" in str(error)
    finally:
        lock.close()
    return False


def made(folder: Path, what: str) -> None:
    """Make a store in a folder of its own.

    Args:
        folder: Folder, made where there is none.
        what: The store is said to be.

    Raises:
        ValueError: If the folder holds anything else.
        OSError: If it cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        found = sorted(path.name for path in folder.iterdir())
        own = (".", NAME, LOCK)  # of writers that were killed
        other = [name for name in found if not name.startswith(own)]
        if other:
            raise ValueError(
                f"expected a {what} or an empty folder; got {folder} with "
                f"{other[0]!r}; {advice(folder, 'choose another folder')}"
            )
        fresh = folder / f"{TEMPORARY}{os.getpid()}-{NAME}"
        finished(created(fresh, secrets.randbits(31)), fresh)
        if not (folder / NAME).exists():  # nobody was faster
            os.replace(fresh, folder / NAME)
            synchronize(folder)
    except (OSError, sqlite3.Error) as error:
        raise OSError(
            getattr(error, "errno", errno.EIO),
            f"expected a folder that can be made for a {what}; got "
            f"{getattr(error, 'strerror', str(error))!r}; choose a place that can be "
            "written",
            str(folder),
        ) from error


def created(path: Path, name: int) -> sqlite3.Connection:
    """Return a new file with its tables and name, in a transaction that has begun."""
    path.unlink(missing_ok=True)
    connection = sqlite3.connect(path, isolation_level=None)
    connection.execute("PRAGMA journal_mode = WAL")
    connection.execute("BEGIN IMMEDIATE")
    for statement in SCHEMA.values():
        connection.execute(statement)
    connection.execute(f"PRAGMA user_version = {FORMAT}")
    connection.execute(f"PRAGMA application_id = {name}")
    return connection


def finished(connection: sqlite3.Connection, path: Path) -> None:
    """Close a new file: all is in it, and on the disk."""
    connection.execute("COMMIT")
    connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    connection.close()
    for suffix in ("-wal", "-shm"):
        path.with_name(path.name + suffix).unlink(missing_ok=True)


def explained(error: Exception, path: Path, what: str) -> Exception:
    """Return an error of SQLite as one of this library."""
    text = str(error)
    if isinstance(error, sqlite3.DataError) or "too big" in text:
        return ValueError(
            "expected rows of at most 1 GB, which SQLite keeps; got a larger one; keep "
            "what is needed of it"
        )
    for words, number in OF_THE_DISK.items():
        if words in text:
            return OSError(
                number,
                f"expected to write to the {what}; got {text!r}; make room or choose a "
                "place that can be written, and run again: what was stored before is "
                "whole",
                str(path),
            )
    return CorruptSegmentError(path, f"what SQLite cannot read ({text})")


def advice(folder: Path, otherwise: str) -> str:
    """Return advice on a folder that has no store."""
    if any((folder / name).exists() for name in ("bank.json", "campaign.json")):
        return f"bring it up to date by: sbi-active migrate {folder}"
    return otherwise

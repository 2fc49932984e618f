"""Attacks on the bank: damaged, crafted and old files, and the bank in use."""

from __future__ import annotations

import json
import os
import pickle
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.robustness.attacks import Attacks
from benchmarks.robustness.bank_damage import ATTACKS as DAMAGE
from benchmarks.robustness.bank_files import (
    FILE,
    execute,
    filled,
    prior,
    refused,
    rows_of,
    same_or_refused,
    simulator,
)
from benchmarks.robustness.bank_in_use import ATTACKS as IN_USE
from sbi_active import Bank
from sbi_active.cli import main
from sbi_active.simulation import reuse
from sbi_active.simulation.bank.store import Store

ATTACKS = Attacks([*IN_USE, *DAMAGE])


def crafted_record(folder: Path, table: str, kind: str, number: int, new: Any) -> None:
    """Put a record with the right checksum."""
    store = Store(folder)
    with store.writing():
        store.put(table, kind, number, new)
    store.close()


def remove(folder: Path, number: int) -> None:
    execute(folder, "DELETE FROM segments WHERE number = ?", number)


def renumber(folder: Path, number: int, another: int) -> None:
    execute(folder, "UPDATE segments SET number = ? WHERE number = ?", another, number)


# Segments that are not where they belong ---------------------------------------------


def _append(folder: Path) -> None:
    with Bank(folder, simulator=simulator) as bank:
        bank.append(rows_of(9), seed=9)


READERS: dict[str, Callable[[Path], Any]] = {
    "len": lambda f: len(Bank(f)),
    "read": lambda f: Bank(f).read([0]),
    "chunks": lambda f: [*Bank(f).chunks(3)],
    "columns": lambda f: Bank(f).columns("x"),
    "counts": lambda f: Bank(f).counts,
    "labels": lambda f: Bank(f).labels,
    "load": lambda f: Bank(f).load("run"),
    "reuse": lambda f: reuse(Bank(f), prior()),
    "append": _append,
}


@ATTACKS.add("a middle segment is removed, then read", cases=(*READERS, "inspect"))
def gap(case: str) -> None:
    folder = filled()
    remove(folder, 2)
    if case == "inspect":
        assert main(["bank", "inspect", str(folder)]) == 1
    else:
        refused(lambda: READERS[case](folder), folder / FILE)


def _swap(f: Path) -> None:
    renumber(f, 2, 9)
    renumber(f, 3, 2)
    renumber(f, 9, 3)


def _close_up(f: Path) -> None:
    remove(f, 2)
    renumber(f, 3, 2)
    renumber(f, 4, 3)
    crafted_record(f, "objects", "segments of rows", 0, {"length": 3})


def _doubled(f: Path, number: int) -> None:
    remove(f, number)
    execute(
        f,
        "INSERT INTO segments SELECT kind, ?, content, digest FROM segments "
        "WHERE number = 2",
        number,
    )
    crafted_record(f, "objects", "segments of rows", 0, {"length": max(number, 4)})


def _of_another(f: Path) -> None:
    remove(f, 2)
    with closing(sqlite3.connect(f / FILE, isolation_level=None)) as connection:
        connection.execute("ATTACH ? AS other", (str(filled("b") / FILE),))
        connection.execute(
            "INSERT INTO segments SELECT * FROM other.segments WHERE number = 2"
        )


def _exchanged(f: Path) -> None:
    for before, after in (("x", "y"), ("theta", "x"), ("y", "theta")):
        execute(
            f,
            "UPDATE segments SET kind = ? WHERE kind = ?",
            f"rows/{after}",
            f"rows/{before}",
        )


def _instead(f: Path, make: Callable[[Path], Any]) -> None:
    (f / FILE).unlink()
    make(f / FILE)


MISPLACED: dict[str, Callable[[Path], Any]] = {
    "first removed": lambda f: remove(f, 1),
    "last removed": lambda f: remove(f, 4),
    "all removed": lambda f: execute(f, "DELETE FROM segments"),
    "a column removed": lambda f: execute(
        f, "DELETE FROM segments WHERE kind = 'rows/x'"
    ),
    "swapped": _swap,
    "doubled at the end": lambda f: _doubled(f, 5),
    "doubled over another": lambda f: _doubled(f, 3),
    "gap closed by hand": _close_up,
    "of another bank": _of_another,
    "columns exchanged": _exchanged,
    "name of another": lambda f: execute(f, "PRAGMA application_id = 7"),
    "a pipe": lambda f: _instead(f, os.mkfifo),
    "a folder": lambda f: _instead(f, Path.mkdir),
    "sparse": lambda f: os.truncate(f / FILE, 2**40),
    "nothing": lambda f: os.truncate(f / FILE, 0),
    "text": lambda f: (f / FILE).write_text("hello" * 9999),
    "a pickle": lambda f: (f / FILE).write_bytes(pickle.dumps(_Executed())),
}


@ATTACKS.add("segments are misplaced", cases=tuple(MISPLACED), seconds=60)
def misplaced(case: str) -> None:
    folder = filled()
    expected = Bank(folder).read()
    MISPLACED[case](folder)
    if case == "sparse":  # all is there, and a terabyte of nothing
        same_or_refused(folder, expected)
        return
    refused(lambda: Bank(folder).read(), folder / FILE)
    refused(lambda: Bank(folder).read(), folder / FILE)  # still
    assert not Path("executed").exists()


@ATTACKS.add("a link in place of a file", cases=("", "-wal", "-shm", "lock"))
def linked(case: str) -> None:
    folder = filled()
    mine = Path("mine.txt")
    mine.write_text("precious")
    place = folder / ("store.lock" if case == "lock" else FILE + case)
    place.unlink(missing_ok=True)
    place.symlink_to(mine.absolute())
    try:
        _append(folder)
    except OSError as error:
        assert "got a link to" in str(error), error
    else:
        raise AssertionError("followed without a word")
    assert mine.read_text() == "precious"


@ATTACKS.add("a journal of somebody else", cases=("store.db", "store.lock"))
def journal(case: str) -> None:
    folder = filled()
    mine = Path("mine.txt").absolute()
    mine.write_text("precious")
    magic = b"\xd9\xd5\x05\xf9 \xa1c\xd7"
    (folder / f"{case}-journal").write_bytes(magic + str(mine).encode())
    refused(lambda: _append(folder), folder)
    assert mine.read_text() == "precious"


@ATTACKS.add("what is lost is given up", cases=("removed", "changed", "a bit"))
def repaired(case: str) -> None:
    folder = filled()
    if case == "changed":
        execute(folder, "UPDATE segments SET content = x'00' WHERE number = 2")
    elif case == "removed":
        remove(folder, 2)
    else:
        content = bytearray((folder / FILE).read_bytes())
        x = rows_of(2).x.numpy().tobytes()
        content[content.index(x)] ^= 1
        (folder / FILE).write_bytes(content)
    with Bank(folder, simulator=simulator) as bank:
        assert len(bank.repair()) == 1
        bank.append(rows_of(1), seed=1)
        # Rows of 1 are there already where those of 2 were lost.
        expected = [0.0, 1.0, 3.0] if case == "a bit" else [0.0, 2.0, 3.0, 1.0]
        assert bank.read().theta[::5, 0].tolist() == expected
        assert bank.verify() == []


# Files made by somebody else ---------------------------------------------------------


HEADERS: dict[str, bytes] = {
    "100,000 deep": b"[" * 100_000 + b"]" * 100_000,
    "objects 500 deep": b'{"version": "", "a": ' + b'{"a":' * 500 + b"1" + b"}" * 501,
    "a list": b"[]",
    "null": b"null",
    "empty": b"",
    "all bytes": bytes(range(256)),
    "UTF-16": '{"version": ""}'.encode("utf-16"),
    "5,000 digits": b'{"version": ' + b"1" * 5_000 + b"}",
    "1e999": b'{"version": 1e999}',
    "NaN": b'{"version": NaN}',
    "only a version": b'{"version": ""}',
    "a pickle": pickle.dumps({"version": ""}),
}


@ATTACKS.add("a crafted header", cases=tuple(HEADERS), seconds=60)
def header(case: str) -> None:
    folder = filled()
    crafted_record(folder, "objects", "bank rows", 0, HEADERS[case])
    refused(lambda: Bank(folder), folder / FILE)
    assert main(["bank", "inspect", str(folder)]) == 2


@ATTACKS.add(
    "an entry of the header has another type, or is missing",
    cases=("version", "simulator", "parameter_names", "shapes", "created", "lost"),
)
def entry(case: str) -> None:
    folder = filled()
    good = Bank(folder).header
    for value in (-1, 1.5, [1.5], [[[]]], {"theta": -3}, {"x": [10**400]}):
        if case == "simulator" and isinstance(value, dict):
            continue  # any object describes a simulator
        crafted_record(folder, "objects", "bank rows", 0, {**good, case: value})
        refused(lambda: Bank(folder), folder / FILE)
    lacking = {key: value for key, value in good.items() if key != case}
    crafted_record(folder, "objects", "bank rows", 0, lacking)
    refused(lambda: Bank(folder), folder / FILE)


KNOWN = {"run": "r", "seed": 1, "label": "", "num_rows": 5, "counts": [5, 0, 0]}


def _known(**values: Any) -> tuple[str, Any]:
    return "rows", json.dumps({**KNOWN, **values}).encode()


CRAFTED: dict[str, tuple[str, Any]] = {
    "-5 rows": _known(num_rows=-5),
    "1e18 rows": _known(num_rows=10**18, counts=[10**18, 0, 0]),
    "rows as text": _known(num_rows="5"),
    "rows as a float": _known(num_rows=5.0),
    "a run as a number": _known(run=3),
    "a seed of a text": _known(seed="1"),
    "a seed of NaN": _known(seed=float("nan")),
    "a label of a list": _known(label=["prior"]),
    "other counts": _known(counts=[0, 5, 0]),
    "negative counts": _known(counts=[10, -5, 0]),
    "four counts": _known(counts=[5, 0, 0, 0]),
    "300 deep": _known(label=json.loads("[" * 300 + "]" * 300)),
    "a pickle": ("rows", pickle.dumps(KNOWN)),
    "an outcome of 7": ("rows/status", bytes([7, 0, 0, 0, 0])),
    "an index of -1": ("rows/index", np.full(5, -1).tobytes()),
    "a short column": ("rows/x", np.zeros((2, 2), np.float32).tobytes()),
    "a narrow column": ("rows/x", np.zeros((5, 1), np.float32).tobytes()),
    "float64": ("rows/x", np.zeros((5, 2)).tobytes()),
    "nothing": ("rows/x", b""),
    "a large column": ("rows/x", bytes(10**8)),
}


@ATTACKS.add("a crafted segment with right checksums", cases=tuple(CRAFTED))
def crafted(case: str) -> None:
    folder = filled()
    kind, content = CRAFTED[case]
    crafted_record(folder, "segments", kind, 2, content)
    bank = Bank(folder)
    refused(
        lambda: bank.columns("x", "status", "seed", "index", "label"), folder / FILE
    )
    assert bank.verify()


STATEMENTS = {
    "a text": "UPDATE segments SET content = 'abc' WHERE kind = 'rows/x'",
    "a number": "UPDATE segments SET content = 7 WHERE kind = 'rows'",
    "nothing": "UPDATE segments SET content = x'' WHERE kind = 'rows/x'",
    "1 GB of nothing": "UPDATE segments SET content = zeroblob(900000000) "
    "WHERE kind = 'rows/x' AND number = 2",
    "no checksum": "UPDATE segments SET digest = x'' WHERE kind = 'rows/x'",
    "checksum of numbers": "UPDATE segments SET digest = 12 WHERE kind = 'rows/x'",
    "a trigger": "CREATE TRIGGER t AFTER INSERT ON segments BEGIN DELETE FROM "
    "segments; END",
    "a view": "CREATE VIEW v AS SELECT load_extension('a') FROM segments",
    "another table": "CREATE TABLE t (a)",
    "an index": "CREATE INDEX i ON segments (upper(kind))",
    "no table": "DROP TABLE segments",
    "a virtual table": "CREATE VIRTUAL TABLE v USING fts5(a)",
}


@ATTACKS.add("what SQLite does and no bank", cases=tuple(STATEMENTS), seconds=60)
def statements(case: str) -> None:
    folder = filled()
    execute(folder, STATEMENTS[case])
    refused(lambda: Bank(folder).columns("x"), folder / FILE)
    assert not Path("executed").exists()


class _Executed:
    """Leaves a file where somebody unpickles it."""

    def __reduce__(self) -> Any:
        return os.mkdir, ("executed",)

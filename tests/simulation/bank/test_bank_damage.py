"""Damaged, crafted and strange files of a bank: one error names them."""

import json
import os
from contextlib import suppress

import numpy as np
import pytest
import torch

from sbi_active import Bank
from sbi_active.simulation import Simulations
from sbi_active.simulation.bank import CorruptSegmentError
from sbi_active.simulation.bank.bank import row_type
from sbi_active.simulation.bank.store import Store
from tests.simulation.bank.filled import (
    FILE,
    append,
    crafted,
    execute,
    filled,
    simulator,
)


@pytest.fixture
def folder(tmp_path):
    return filled(tmp_path / "bank")


HEADERS = {
    "deep": b"[" * 100_000 + b"]" * 100_000,
    "deep in simulator": b'{"simulator": ' + b'{"a":' * 500 + b"1",
    "bytes": bytes(range(256)),
    "infinite": b'{"created": Infinity}',
    "no shapes": {},
    **{f"shapes {s}": {"shapes": s} for s in (-1, [1.5], [[[]]], {"theta": 3})},
}


@pytest.mark.parametrize("content", HEADERS.values(), ids=HEADERS.keys())
def test_crafted_headers(folder, content):
    if not isinstance(content, bytes):
        header = Bank(folder).header
        content = {k: v for k, v in header.items() if k != "shapes"} | content
    crafted(folder, "bank rows", 0, content)
    with pytest.raises(CorruptSegmentError, match=r"store\.db"):
        Bank(folder)


@pytest.mark.parametrize("make", [os.mkfifo, os.mkdir, "sparse", "empty", "text"])
def test_files_that_are_no_store(folder, make):
    path = folder / FILE
    path.unlink()
    if make == "sparse":
        with path.open("wb") as file:
            file.truncate(2**40)
    elif isinstance(make, str):
        path.write_text({"empty": "", "text": "hello" * 1000}[make])
    else:
        make(path)
    for options in ({}, {"simulator": simulator}):
        with pytest.raises((CorruptSegmentError, ValueError), match=r"store\.db"):
            Bank(folder, **options)


KNOWN = {"run": "r", "seed": 1}
ROWS = np.zeros(5, row_type({"theta": [2], "action": [1], "x": [2]}))


def head(rows=ROWS, **known):
    return json.dumps({**KNOWN, **known}).encode() + b"\n" + rows.tobytes()


def changed(name, place, value):
    rows = ROWS.copy()
    rows[name][place] = value
    return head(rows)


X = np.zeros((5, 2), np.float32).tobytes()
SEGMENTS = {
    "other rows than x": ("rows", head(ROWS[:3])),
    "an outcome of 7": ("rows", changed("status", 0, 7)),
    "an index of -1": ("rows", changed("index", 2, -1)),
    "a short column": ("x of rows", X[:-16]),
}


@pytest.mark.parametrize("change", SEGMENTS.values(), ids=SEGMENTS.keys())
def test_crafted_segments(folder, change):
    kind, content = change
    crafted(folder, kind, 2, content)
    with pytest.raises(CorruptSegmentError, match=str(folder)):
        Bank(folder).read()


LARGE = "x'" + "00" * 1000 + "'"
STATEMENTS = {
    "a text": "UPDATE records SET content = 'abc' WHERE kind = 'x of rows'",
    "another content": f"UPDATE records SET content = {LARGE} WHERE kind = 'x of rows'",
    "another name": "PRAGMA application_id = 7",
    "no x": "UPDATE records SET content = x'' WHERE kind = 'x of rows' AND number = 2",
    "no rows": "DELETE FROM records WHERE kind = 'rows'",
    "no catalog": "DELETE FROM records WHERE kind = 'catalog'",
    "no header": "UPDATE records SET content = 'a' WHERE kind = 'bank rows'",
    "a trigger": "CREATE TRIGGER t AFTER INSERT ON records BEGIN DELETE FROM records;"
    " END",
    "an index": "CREATE INDEX i ON records (upper(kind))",
}


@pytest.mark.parametrize("statement", STATEMENTS.values(), ids=STATEMENTS.keys())
def test_what_anybody_can_do_with_sqlite(folder, statement):
    execute(folder, statement)
    with pytest.raises(CorruptSegmentError, match=str(folder)):
        Bank(folder).read()


@pytest.mark.parametrize("catalog", [{"rows": "4"}, {"rows": 10**18}, None])
def test_crafted_catalogs(folder, catalog):
    content = json.dumps({"bank rows": 0, **catalog} if catalog else catalog).encode()
    crafted(folder, "catalog", 0, content)
    with pytest.raises((CorruptSegmentError, ValueError), match=str(folder)):
        Bank(folder).read()
    with pytest.raises((CorruptSegmentError, ValueError), match=str(folder)):
        Store(folder).verify()


def test_a_view_in_place_of_a_table_is_not_read(folder):
    execute(folder, "DROP TABLE records")
    endless = (
        "CREATE VIEW records AS WITH RECURSIVE n(kind) AS (SELECT 1 UNION ALL SELECT "
        "kind + 1 FROM n) SELECT kind, kind AS number, x'' AS digest, x'' AS content "
        "FROM n"
    )
    execute(folder, endless)
    with pytest.raises(CorruptSegmentError, match="tables that are not those"):
        Bank(folder)


@pytest.mark.parametrize("name", [FILE, "store.db-wal", "store.db-shm", "store.lock"])
def test_links_lead_nowhere(folder, tmp_path, name):
    mine = tmp_path / "mine.txt"
    for content in ("", "precious" * 1000):
        mine.write_text(content)
        (folder / name).unlink(missing_ok=True)
        (folder / name).symlink_to(mine)
        with (
            pytest.raises(OSError, match="got store.*, a link"),
            Bank(folder, simulator=simulator) as bank,
        ):
            append(bank, Simulations(*[torch.ones(1, 2)] * 3), 5)
        assert mine.read_text() == content


@pytest.mark.parametrize("name", ["store.db-journal", "store.lock-journal"])
def test_a_journal_of_somebody_else_is_not_played_back(folder, tmp_path, name):
    # One that names a file to be removed is removed with that file by SQLite.
    (tmp_path / "mine.txt").write_text("precious")
    super_journal = str(tmp_path / "mine.txt").encode()
    (folder / name).write_bytes(b"\xd9\xd5\x05\xf9 \xa1c\xd7" + super_journal)
    with (
        pytest.raises(CorruptSegmentError, match="a journal, which none leaves"),
        Bank(folder, simulator=simulator) as bank,
    ):
        append(bank, Simulations(*[torch.ones(1, 2)] * 3), 5)
    assert (tmp_path / "mine.txt").exists()
    assert (folder / name).exists()


@pytest.mark.parametrize("first", range(3))
def test_a_flipped_bit_or_a_cut_gives_the_rows_or_the_error(folder, first):
    path = folder / FILE
    expected, content = Bank(folder).read(), path.read_bytes()
    for place in range(3 + 331 * first, len(content), 997):
        flipped = bytearray(content)
        flipped[place] ^= 1 << place % 8
        for damaged in (bytes(flipped), content[:place]):
            path.write_bytes(damaged)
            with suppress(CorruptSegmentError):
                assert torch.equal(Bank(folder).read().x, expected.x)


def test_the_log_of_another_file_is_noticed(folder, tmp_path):
    other = Bank(filled(tmp_path / "other"), simulator=simulator)
    append(other, Simulations(*[torch.ones(5, k) for k in (2, 1, 2)]), 8)
    log = (other.path / "store.db-wal").read_bytes()
    assert len(log) > 1000
    (folder / "store.db-wal").write_bytes(log)
    with pytest.raises(CorruptSegmentError):
        Bank(folder).read()


def test_numbers_that_float32_cannot_hold_and_seeds_beyond_int64(folder):
    rows = torch.ones(3, 2)
    with Bank(folder, simulator=simulator) as bank:
        large = Simulations(rows, rows[:, :1], rows.double() * 1e39)
        with pytest.raises(ValueError, match=r"x within \+-3.4e38.*got 1e\+39"):
            append(bank, large, 0)
        for seed in (np.int64(8), 2**70):
            assert append(bank, Simulations(rows, rows[:, :1], rows), seed) == 3
    assert len(Bank(folder)) == 26


# Segments missing, exchanged or of another bank: one error names them


def remove(folder, number):
    execute(folder, "DELETE FROM records WHERE kind = 'rows' AND number = ?", number)


def renumber(folder, number, another):
    statement = "UPDATE records SET number = ? WHERE kind = 'rows' AND number = ?"
    execute(folder, statement, another, number)


def swap(folder):
    renumber(folder, 2, 9)
    renumber(folder, 3, 2)
    renumber(folder, 9, 3)


def duplicate_in_place_of_another(folder):
    remove(folder, 3)
    copied = "SELECT kind, 3, digest, content FROM records WHERE number = 2"
    execute(folder, f"INSERT INTO records {copied} AND kind = 'rows'")


def close_the_gap_by_hand(folder):
    remove(folder, 2)
    renumber(folder, 3, 2)
    renumber(folder, 4, 3)
    crafted(folder, "catalog", 0, {"bank rows": 0, "rows": 3})


def take_from_another_bank(folder):
    other = filled(folder.parent / "other")
    remove(folder, 2)
    (row,) = execute(other, "SELECT * FROM records WHERE kind = 'rows' AND number = 2")
    execute(folder, "INSERT INTO records VALUES (?, ?, ?, ?)", *row)


MISPLACED = [swap, duplicate_in_place_of_another, close_the_gap_by_hand]
MISPLACED += [take_from_another_bank]


@pytest.mark.parametrize("misplace", MISPLACED)
def test_misplaced_segments_are_named(folder, misplace):
    misplace(folder)
    with pytest.raises(CorruptSegmentError, match=str(folder / FILE)):
        Bank(folder).read()
    with pytest.raises(CorruptSegmentError):
        Bank(folder).verify()
    with pytest.raises(CorruptSegmentError):  # still
        Bank(folder).read()


def test_a_bank_of_an_earlier_release_is_named(tmp_path):
    (tmp_path / "bank.json").write_text("{}")
    for options in ({}, {"simulator": simulator}):
        with pytest.raises(ValueError, match="sbi-active migrate"):
            Bank(tmp_path, **options)

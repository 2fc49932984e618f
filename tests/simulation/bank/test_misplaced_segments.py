"""Segments missing, exchanged or of another bank: one error names them."""

import shutil

import pytest

from sbi_active import Bank
from sbi_active.simulation.bank import CorruptSegmentError
from tests.simulation.bank.filled import (
    FILE,
    crafted,
    execute,
    fill,
    filled,
    flip,
    remove,
    simulator,
)


@pytest.fixture
def folder(tmp_path):
    return filled(tmp_path / "bank")


def renumber(folder, number, another):
    statement = "UPDATE records SET number = ? WHERE kind = 'rows' AND number = ?"
    execute(folder, statement, another, number)


def swap(folder):
    renumber(folder, 2, 9)
    renumber(folder, 3, 2)
    renumber(folder, 9, 3)


def duplicate_in_place_of_another(folder):
    remove(folder, 3)
    execute(
        folder,
        "INSERT INTO records SELECT kind, 3, head, head_digest, body_digest, body FROM "
        "records WHERE kind = 'rows' AND number = 2",
    )


def close_the_gap_by_hand(folder):
    remove(folder, 2)
    renumber(folder, 3, 2)
    renumber(folder, 4, 3)
    crafted(folder, "catalog", 0, {"bank rows": 0, "rows": 3})


def take_from_another_bank(folder):
    other = filled(folder.parent / "other")
    remove(folder, 2)
    (row,) = execute(other, "SELECT * FROM records WHERE kind = 'rows' AND number = 2")
    execute(folder, "INSERT INTO records VALUES (?, ?, ?, ?, ?, ?)", *row)


def lose_x(folder):
    execute(folder, "UPDATE records SET body = x'' WHERE kind = 'rows' AND number = 2")


def lose_all(folder):
    execute(folder, "DELETE FROM records WHERE kind = 'rows'")


@pytest.mark.parametrize(
    "misplace",
    [
        swap,
        duplicate_in_place_of_another,
        close_the_gap_by_hand,
        take_from_another_bank,
        lose_x,
        lose_all,
    ],
)
def test_misplaced_segments_are_named(folder, misplace):
    misplace(folder)
    with pytest.raises(CorruptSegmentError, match=str(folder / FILE)):
        Bank(folder).read()
    assert Bank(folder).verify()
    with pytest.raises(CorruptSegmentError):  # still
        Bank(folder).read()


def test_repair_gives_up_what_is_lost_and_no_more(folder):
    before = (folder / FILE).read_bytes()
    remove(folder, 2)
    execute(
        folder, "UPDATE records SET body = x'00' WHERE kind = 'rows' AND number = 3"
    )
    reader = Bank(folder)
    with Bank(folder, simulator=simulator) as bank:
        assert len(bank.repair()) == 2
        assert bank.read().theta[:, 0].tolist() == [0.0] * 5 + [3.0] * 5
        assert bank.verify() == []
        fill(bank, (1, 2))  # simulated again
    assert reader.columns("seed")["seed"][::5].tolist() == [0, 3, 1, 2]
    assert len((folder / f"{FILE}.damaged").read_bytes()) == len(before)
    assert Bank(folder).verify() == []
    remove(folder, 4)
    with Bank(folder, simulator=simulator) as again:
        assert len(again.repair()) == 1
        assert again.columns("seed")["seed"][::5].tolist() == [0, 3, 1]


def test_repair_of_pages_that_sqlite_cannot_read(folder):
    with Bank(folder, simulator=simulator) as bank:
        fill(bank, range(10, 160), num=100)
        expected = bank.read()
    size = (folder / FILE).stat().st_size
    assert size > 80 * 4_096  # the first eight pages hold what all else rests on
    for position in (size // 2, 3 * size // 4):
        for k in range(200):
            flip(folder / FILE, position // 4_096 * 4_096 + k)
    with pytest.raises(CorruptSegmentError):
        Bank(folder).read()
    with Bank(folder, simulator=simulator) as bank:
        assert bank.repair()
        assert bank.verify() == []
        kept = bank.columns("seed", "theta")
    assert 0 < len(kept["seed"]) < len(expected)
    assert (kept["theta"][:, 0] == kept["seed"]).all()
    assert (folder / f"{FILE}.damaged").exists()


def test_a_bank_of_an_earlier_release_is_named(tmp_path):
    (tmp_path / "bank.json").write_text("{}")
    for options in ({}, {"simulator": simulator}):
        with pytest.raises(ValueError, match="sbi-active migrate"):
            Bank(tmp_path, **options)
    shutil.rmtree(tmp_path)

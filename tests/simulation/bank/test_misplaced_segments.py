"""Segments missing, exchanged or of another bank: one error names them."""

import shutil

import pytest

from sbi_active import Bank
from sbi_active.simulation.bank import CorruptSegmentError
from tests.simulation.bank.filled import (
    FILE,
    crafted,
    execute,
    filled,
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
        "INSERT INTO records SELECT kind, 3, digest, content FROM records WHERE "
        "kind = 'rows' AND number = 2",
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
    execute(folder, "INSERT INTO records VALUES (?, ?, ?, ?)", *row)


def lose_x(folder):
    change = "UPDATE records SET content = x'' WHERE kind = 'x of rows' AND number = 2"
    execute(folder, change)


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
    with pytest.raises(CorruptSegmentError):
        Bank(folder).verify()
    with pytest.raises(CorruptSegmentError):  # still
        Bank(folder).read()


def test_a_bank_of_an_earlier_release_is_named(tmp_path):
    (tmp_path / "bank.json").write_text("{}")
    for options in ({}, {"simulator": simulator}):
        with pytest.raises(ValueError, match="sbi-active migrate"):
            Bank(tmp_path, **options)
    shutil.rmtree(tmp_path)

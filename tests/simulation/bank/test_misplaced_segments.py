"""Segments missing, renamed, swapped or of another bank: one error names them."""

import json
import os
import shutil

import pytest

from sbi_active import Bank
from sbi_active.cli import main
from sbi_active.simulation import reuse
from sbi_active.simulation.bank import CorruptSegmentError, read_segment, write_segment
from tests.simulation.bank.filled import (
    appended,
    fill,
    filled,
    prior,
    segment,
    simulator,
)


@pytest.fixture
def folder(tmp_path):
    return filled(tmp_path / "bank")


READERS = {
    "len": lambda folder: len(Bank(folder)),
    "read": lambda folder: Bank(folder).read([0]),
    "chunks": lambda folder: [*Bank(folder).chunks(3)],
    "columns": lambda folder: Bank(folder).columns("x"),
    "counts": lambda folder: Bank(folder).counts,
    "labels": lambda folder: Bank(folder).labels,
    "load": lambda folder: Bank(folder).load("run"),
    "reuse": lambda folder: reuse(Bank(folder), prior()),
    "append": appended,
    "compact": lambda folder: Bank(folder, simulator=simulator).compact(),
}


@pytest.mark.parametrize("reader", READERS)
def test_a_gap_is_told_by_every_reader(folder, reader):
    segment(folder, 2).unlink()
    text = r"expected .*segments as it was written; got a gap: segments 2 to 2 are not"
    with pytest.raises(CorruptSegmentError, match=text):
        READERS[reader](folder)


def rename_to_another_name(folder):
    segment(folder, 2).rename(segment(folder, 2).with_name("2.h5"))


def swap(folder):
    spare = folder / "spare"
    segment(folder, 2).rename(spare)
    segment(folder, 3).rename(segment(folder, 2))
    spare.rename(segment(folder, 3))


def duplicate_at_the_end(folder):
    shutil.copy(segment(folder, 2), segment(folder, 5))


def duplicate_in_place_of_another(folder):
    shutil.copy(segment(folder, 2), segment(folder, 3))


def stretch(folder):
    segment(folder, 2).rename(segment(folder, 1, 4))


def overlap(folder):
    segment(folder, 4).rename(segment(folder, 3, 5))


def close_the_gap_by_hand(folder):
    segment(folder, 2).unlink()
    segment(folder, 3).rename(segment(folder, 2))
    segment(folder, 4).rename(segment(folder, 3))


def take_from_another_bank(folder):
    with Bank(folder.parent / "other", simulator=simulator) as other:
        fill(other)
    shutil.copy(segment(other.path, 2), segment(folder, 2))


def take_the_header_of_another_bank(folder):
    with Bank(folder.parent / "other", simulator=simulator) as other:
        fill(other)
    shutil.copy(other.path / "bank.json", folder / "bank.json")


def lose_the_last(folder):
    segment(folder, 4).unlink()


def lose_all(folder):
    shutil.rmtree(folder / "segments")


def link_to_nothing(folder):
    segment(folder, 2).unlink()
    segment(folder, 2).symlink_to("nowhere")


def put_a_pipe(folder):
    segment(folder, 2).unlink()
    os.mkfifo(segment(folder, 2))


def put_a_folder(folder):
    segment(folder, 2).unlink()
    segment(folder, 2).mkdir()


@pytest.mark.parametrize(
    "misplace",
    [
        rename_to_another_name,
        swap,
        duplicate_at_the_end,
        duplicate_in_place_of_another,
        stretch,
        overlap,
        close_the_gap_by_hand,
        take_from_another_bank,
        take_the_header_of_another_bank,
        lose_the_last,
        lose_all,
        link_to_nothing,
        put_a_pipe,
        put_a_folder,
    ],
)
def test_misplaced_segments_are_named(folder, misplace, capsys):
    misplace(folder)
    with pytest.raises(CorruptSegmentError, match=str(folder / "segments")):
        Bank(folder).read()
    assert Bank(folder).verify()
    assert main(["bank", "inspect", str(folder)]) == 1
    assert capsys.readouterr().out.startswith("checksums: NOT ok")
    before = sorted(p.name for p in folder.glob("segments/*"))
    with pytest.raises(CorruptSegmentError):
        appended(folder)
    assert sorted(p.name for p in folder.glob("segments/*")) == before
    with pytest.raises(CorruptSegmentError):  # still
        Bank(folder).read()


def test_repair_gives_up_what_is_lost_and_no_more(folder):
    segment(folder, 2).unlink()
    segment(folder, 3).write_bytes(b"half")
    with Bank(folder, simulator=simulator) as bank:
        assert len(bank.repair()) == 2
        assert bank.read().theta[:, 0].tolist() == [0.0] * 5 + [3.0] * 5
        assert bank.verify() == []
        fill(bank, (1, 2))  # simulated again
        bank.compact()
    again = Bank(folder)
    assert again.columns("seed")["seed"][::5].tolist() == [0, 3, 1, 2]
    assert segment(folder, 3).with_suffix(".h5.damaged").read_bytes() == b"half"
    segment(folder, 1, 6).unlink()
    with pytest.raises(CorruptSegmentError, match="segments 1 to 6 are not there"):
        again.read()


def test_banks_written_before_segments_had_a_place_are_read(folder):
    header = json.loads((folder / "bank.json").read_text())
    for name in ("id", "num_segments", "lost"):
        del header[name]
    (folder / "bank.json").write_text(json.dumps(header))
    for number in range(1, 5):
        columns, meta = read_segment(segment(folder, number), None)
        meta = {k: meta[k] for k in ("num_rows", "counts", "runs")}
        write_segment(segment(folder, number), columns, meta)
    appended(folder)
    bank = Bank(folder)
    assert bank.read().theta[::5, 0].tolist() == [0, 1, 2, 3, 9]
    assert bank.verify() == []
    segment(folder, 2).unlink()
    with pytest.raises(CorruptSegmentError, match="segments 2 to 2 are not there"):
        bank.read()

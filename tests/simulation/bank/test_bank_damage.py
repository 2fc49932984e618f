"""Damaged, crafted and old files of a bank: one error names them."""

import copy
import hashlib
import json
import os
from contextlib import suppress
from typing import Any

import h5py
import numpy as np
import pytest
import torch

from sbi_active import Bank
from sbi_active.cli import main
from sbi_active.simulation import Simulations
from sbi_active.simulation.bank import CorruptSegmentError, read_segment, write_segment
from tests.simulation.bank.filled import (
    filled,
    segment,
    simulator,
)


@pytest.fixture
def folder(tmp_path):
    return filled(tmp_path / "bank")


HEADERS = {
    "deep": b"[" * 100_000 + b"]" * 100_000,
    "deep in simulator": b'{"format": 1, "simulator": ' + b'{"a":' * 500 + b"1",
    "list": b"[]",
    "null": b"null",
    "empty": b"",
    "bytes": bytes(range(256)),
    "large number": b'{"format": ' + b"1" * 5_000 + b"}",
    "infinite": b'{"format": Infinity}',
    "text": b'{"format": "1"}',
    "true": b'{"format": true}',
    "only the format": b'{"format": 1}',
}


@pytest.mark.parametrize("content", HEADERS.values(), ids=HEADERS.keys())
def test_crafted_headers(folder, content):
    (folder / "bank.json").write_bytes(content)
    with pytest.raises(CorruptSegmentError, match=r"bank\.json as it was written"):
        Bank(folder)
    assert main(["bank", "inspect", str(folder)]) == 2


@pytest.mark.parametrize("make", [os.mkfifo, os.mkdir, "sparse"])
def test_headers_that_are_no_texts(folder, make):
    path = folder / "bank.json"
    path.unlink()
    if make == "sparse":
        with path.open("wb") as file:
            file.truncate(2**40)
    else:
        make(path)
    with pytest.raises(CorruptSegmentError, match=r"bank\.json"):
        Bank(folder)


@pytest.mark.parametrize(
    "name",
    [
        "version",
        "simulator",
        "parameter_names",
        "shapes",
        "created",
        "num_segments",
        "lost",
        "id",
    ],
)
def test_entries_of_other_types(folder, name):
    header = json.loads((folder / "bank.json").read_text())
    for value in (-1, float("nan"), [1], {"theta": 3}):
        if (name, value) == ("simulator", {"theta": 3}):
            continue  # any object describes a simulator
        (folder / "bank.json").write_text(json.dumps({**header, name: value}))
        with pytest.raises(CorruptSegmentError, match=r"bank\.json"):
            Bank(folder)


def crafted(path, change):
    """Write a segment again with changed meta data and the right checksums."""
    columns, meta = read_segment(path, None)
    meta = {key: meta[key] for key in meta.keys() - {"shapes", "checksums"}}
    meta = change(columns, copy.deepcopy(meta)) or meta
    write_segment(path, columns, meta)


def _set(key, value):
    return lambda columns, meta: {**meta, key: value}


def _put(column, value):
    def change(columns, meta):
        columns[column][0] = value

    return change


def _replace(column, value):
    def change(columns, meta):
        columns[column] = value

    return change


SEGMENTS = {
    "negative rows": _set("num_rows", -5),
    "many rows": _set("num_rows", 10**18),
    "rows as a text": _set("num_rows", "5"),
    "no runs": _set("runs", []),
    "a run of nothing": _set("runs", [{}]),
    "a run as a number": _set("runs", 3),
    "a seed of a text": _set("runs", [{"digest": "", "seed": "1", "label": ""}]),
    "other counts": _set("counts", [0, 5, 0]),
    "negative counts": _set("counts", [10, -5, 0]),
    "four counts": _set("counts", [5, 0, 0, 0]),
    "nested": _set("numbers", json.loads("[" * 300 + "]" * 300)),
    "an outcome of 7": _put("status", 7),
    "a run of -1": _put("run", -1),
    "an index of -1": _put("index", -1),
    "a short column": _replace("x", np.zeros((2, 2), np.float32)),
    "a column of float64": _replace("x", np.zeros((5, 2))),
    "a wide column": _replace("x", np.zeros((5, 1), np.float32)),
    "a number": _replace("x", np.float32(3)),
    "a text": _replace("x", np.array([b"abc"] * 5)),
}


@pytest.mark.parametrize("change", SEGMENTS.values(), ids=SEGMENTS.keys())
def test_crafted_segments(folder, change):
    path = segment(folder, 2)
    crafted(path, change)
    with pytest.raises(CorruptSegmentError, match=str(path)):
        Bank(folder).columns("x", "status", "seed", "index")
    assert any(str(path) in line for line in Bank(folder).verify())


def _dataset(**options):
    def change(file):
        del file["x"]
        file.create_dataset("x", **options)

    return change


def _link(link):
    def change(file):
        del file["x"]
        file["x"] = link(file)

    return change


def _huge(file):
    del file["x"]
    file.create_dataset("x", shape=(5, 10**15), dtype="f4", chunks=(1, 10**4))


def _meta_of(text):
    def change(file):
        del file["meta"]
        file.create_dataset("meta", data=np.frombuffer(text, np.uint8))
        file.attrs["sha256"] = hashlib.sha256(text).hexdigest()

    return change


FILES = {
    "another file": _link(lambda file: h5py.ExternalLink("/etc/passwd", "/x")),
    "itself": _link(lambda file: h5py.SoftLink("/x")),
    "a name within": _link(lambda file: h5py.SoftLink("/theta")),
    "a group": lambda file: (file.__delitem__("x"), file.create_group("x")),
    "outside": _dataset(
        shape=(5, 2), dtype="f4", external=[("/etc/passwd", 0, h5py.h5f.UNLIMITED)]
    ),
    "compressed": _dataset(data=np.zeros((5, 2), "f4"), compression="gzip"),
    "objects": _dataset(data=[["a", "b"]] * 5, dtype=h5py.string_dtype()),
    "nothing": _dataset(data=h5py.Empty("f4")),
    "huge": _huge,
    "deep": _meta_of(b"[" * 100_000 + b"]" * 100_000),
    "infinite": _meta_of(b'{"num_rows": Infinity}'),
    "no JSON": _meta_of(b"\xff\xfe"),
    "checksum of numbers": lambda file: file.attrs.__setitem__("sha256", [1, 2]),
    "no checksum": lambda file: file.attrs.__delitem__("sha256"),
}


@pytest.mark.parametrize("change", FILES.values(), ids=FILES.keys())
def test_files_that_only_hdf5_can_make(folder, change):
    path = segment(folder, 2)
    with h5py.File(path, "r+") as file:
        change(file)
    with pytest.raises(CorruptSegmentError, match=str(path)):
        Bank(folder).columns("x")
    assert any(str(path) in line for line in Bank(folder).verify())


def test_a_flipped_bit_or_a_cut_gives_the_rows_or_the_error(folder):
    path = segment(folder, 2)
    expected, content = Bank(folder).read(), path.read_bytes()
    for place in range(3, len(content), 997):
        flipped = bytearray(content)
        flipped[place] ^= 1 << place % 8
        for damaged in (bytes(flipped), content[:place]):
            path.write_bytes(damaged)
            with suppress(CorruptSegmentError):
                assert torch.equal(Bank(folder).read().x, expected.x)


def test_all_of_the_structure_has_checksums(folder):
    # The older kind of file has none, and HDF5 reads some flipped ones for ever.
    with segment(folder, 1).open("rb") as file:
        assert file.read(9) == b"\x89HDF\r\n\x1a\n\x02"


def test_control_characters_do_not_reach_the_terminal(folder, capsys):
    header = json.loads((folder / "bank.json").read_text())
    header["created"] = "\x1b[2J\ud800"
    (folder / "bank.json").write_text(json.dumps(header))
    assert main(["bank", "inspect", str(folder)]) == 0
    assert r"created: '\x1b[2J\ud800'" in capsys.readouterr().out


def test_columns_and_sizes_that_are_none(folder):
    bank = Bank(folder)
    with pytest.raises(ValueError, match=r"expected columns among .*got \['thetas'\]"):
        bank.columns("thetas")
    with pytest.raises(ValueError, match="expected size >= 1; got 0"):
        next(bank.chunks(0))


def test_numbers_that_float32_cannot_hold(folder):
    rows = torch.ones(3, 2)
    with Bank(folder, simulator=simulator) as bank:
        large = Simulations(rows, rows[:, :1], rows.double() * 1e39)
        with pytest.raises(ValueError, match=r"x within \+-3.4e38.*got 1e\+39"):
            bank.append(large, seed=0)
        with pytest.raises(ValueError, match=r"x of real numbers; got torch.complex64"):
            bank.append(
                Simulations(rows, rows[:, :1], rows + 1j, torch.zeros(3)), seed=0
            )
        eight: Any = np.int64(8)
        assert bank.append(Simulations(rows, rows[:, :1], rows), seed=eight) == 3
    assert len(Bank(folder)) == 23


def test_seeds_beyond_int64_are_stored(folder):
    rows = torch.ones(3, 2)
    with Bank(folder, simulator=simulator) as bank:
        assert bank.append(Simulations(rows, rows[:, :1], rows), seed=2**70) == 3
    assert len(Bank(folder).read()) == 23
    with pytest.raises(ValueError, match=r"seeds below 2\*\*63 .* got one of 71 bits"):
        Bank(folder).columns("seed")

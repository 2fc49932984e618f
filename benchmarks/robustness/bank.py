"""Attacks on the bank: damaged, crafted and old files, and the bank in use."""

from __future__ import annotations

import json
import os
import pickle
import random
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import torch

from benchmarks.robustness.attacks import Attacks
from benchmarks.robustness.bank_in_use import ATTACKS as IN_USE
from sbi_active import Bank
from sbi_active.cli import main
from sbi_active.simulation import Simulations, reuse
from sbi_active.simulation.bank import CorruptSegmentError, read_segment, write_segment

ATTACKS = Attacks(IN_USE)


def simulator(theta: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
    return theta


def prior() -> torch.distributions.MultivariateNormal:
    return torch.distributions.MultivariateNormal(torch.zeros(2), torch.eye(2))


def rows_of(seed: int, num_rows: int = 5) -> Simulations:
    theta = torch.full((num_rows, 2), float(seed))
    return Simulations(theta, theta[:, :1], theta)


def filled(name: str = "bank", seeds: Any = range(4)) -> Path:
    with Bank(name, simulator=simulator) as bank:
        for seed in seeds:
            bank.append(rows_of(seed), seed=seed, proposal=prior(), label="prior")
    return Path(name)


def segment(folder: Path, first: int, last: int | None = None) -> Path:
    return folder / "segments" / f"{first:08d}-{last or first:08d}.h5"


def refused(act: Callable[[], Any], named: Path) -> None:
    """Raise unless the one error comes, which names a file or its folder."""
    try:
        act()
    except CorruptSegmentError as error:
        said = str(error)
    else:
        raise AssertionError("read without a word")
    assert str(named) in said, said


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
    "size": lambda f: Bank(f).num_bytes,
    "load": lambda f: Bank(f).load("run"),
    "reuse": lambda f: reuse(Bank(f), prior()),
    "append": _append,
    "compact": lambda f: Bank(f, simulator=simulator).compact(),
}


@ATTACKS.add("a middle segment is removed, then read", cases=(*READERS, "inspect"))
def gap(case: str) -> None:
    folder = filled()
    segment(folder, 2).unlink()
    if case == "inspect":
        assert main(["bank", "inspect", str(folder)]) == 1
    else:
        refused(lambda: READERS[case](folder), folder / "segments")


def _swap(f: Path) -> None:
    segment(f, 2).rename(f / "spare")
    segment(f, 3).rename(segment(f, 2))
    (f / "spare").rename(segment(f, 3))


def _close_up(f: Path) -> None:
    segment(f, 2).unlink()
    segment(f, 3).rename(segment(f, 2))
    segment(f, 4).rename(segment(f, 3))


def _instead(f: Path, make: Callable[[Path], Any]) -> None:
    segment(f, 2).unlink()
    make(segment(f, 2))


MISPLACED: dict[str, Callable[[Path], Any]] = {
    "first removed": lambda f: segment(f, 1).unlink(),
    "last removed": lambda f: segment(f, 4).unlink(),
    "all removed": lambda f: shutil.rmtree(f / "segments"),
    "renamed": lambda f: segment(f, 2).rename(f / "segments" / "2.h5"),
    "swapped": _swap,
    "doubled at the end": lambda f: shutil.copy(segment(f, 2), segment(f, 5)),
    "doubled over another": lambda f: shutil.copy(segment(f, 2), segment(f, 3)),
    "named as a merger": lambda f: segment(f, 2).rename(segment(f, 1, 4)),
    "overlapping": lambda f: segment(f, 4).rename(segment(f, 3, 5)),
    "gap closed by hand": _close_up,
    "of another bank": lambda f: shutil.copy(segment(filled("b"), 2), segment(f, 2)),
    "header of another": lambda f: shutil.copy(filled("b") / "bank.json", f),
    "a link to nothing": lambda f: _instead(f, lambda p: p.symlink_to("nowhere")),
    "a pipe": lambda f: _instead(f, os.mkfifo),
    "a folder": lambda f: _instead(f, Path.mkdir),
    "a device": lambda f: _instead(f, lambda p: p.symlink_to("/dev/zero")),
}


@ATTACKS.add("segments are misplaced", cases=tuple(MISPLACED), seconds=60)
def misplaced(case: str) -> None:
    folder = filled()
    MISPLACED[case](folder)
    refused(Bank(folder).read, folder / "segments")
    assert Bank(folder).verify()
    refused(lambda: _append(folder), folder / "segments")
    refused(Bank(folder).read, folder / "segments")  # still


@ATTACKS.add("what is lost is given up", cases=("removed", "cut", "merged"))
def repaired(case: str) -> None:
    folder = filled()
    if case == "merged":
        Bank(folder, simulator=simulator).compact()
        segment(folder, 1, 4).unlink()
    elif case == "cut":
        segment(folder, 2).write_bytes(segment(folder, 2).read_bytes()[:100])
    else:
        segment(folder, 2).unlink()
    with Bank(folder, simulator=simulator) as bank:
        assert len(bank.repair()) == 1
        bank.append(rows_of(1), seed=1)
        expected = [1.0] if case == "merged" else [0.0, 2.0, 3.0, 1.0]
        assert bank.read().theta[::5, 0].tolist() == expected
        assert bank.verify() == []


# Files made by somebody else ---------------------------------------------------------


HEADERS: dict[str, bytes] = {
    "100,000 deep": b"[" * 100_000 + b"]" * 100_000,
    "objects 500 deep": b'{"format": 1, "a": ' + b'{"a":' * 500 + b"1" + b"}" * 501,
    "a list": b"[]",
    "null": b"null",
    "empty": b"",
    "all bytes": bytes(range(256)),
    "UTF-16": '{"format": 1}'.encode("utf-16"),
    "5,000 digits": b'{"format": ' + b"1" * 5_000 + b"}",
    "1e999": b'{"format": 1e999}',
    "NaN": b'{"format": NaN}',
    "a text as format": b'{"format": "1"}',
    "true as format": b'{"format": true}',
    "only a format": b'{"format": 1}',
    "a pickle": pickle.dumps({"format": 1}),
}


@ATTACKS.add("a crafted header", cases=tuple(HEADERS), seconds=60)
def header(case: str) -> None:
    folder = filled()
    (folder / "bank.json").write_bytes(HEADERS[case])
    refused(lambda: Bank(folder), folder / "bank.json")
    assert main(["bank", "inspect", str(folder)]) == 2


ENTRIES = ("version", "simulator", "parameter_names", "shapes", "created")


@ATTACKS.add(
    "an entry of the header has another type, or is missing",
    cases=(*ENTRIES, "num_segments", "lost", "id"),
)
def entry(case: str) -> None:
    folder = filled()
    path = folder / "bank.json"
    good = json.loads(path.read_text())
    for value in (-1, 1.5, float("nan"), [1], [[[]]], {"theta": -3}, {"x": [10**400]}):
        if case == "simulator" and isinstance(value, dict):
            continue  # any object describes a simulator
        path.write_text(json.dumps({**good, case: value}))
        refused(lambda: Bank(folder), path)
    path.write_text(json.dumps({k: v for k, v in good.items() if k != case}))
    if case in ENTRIES:
        refused(lambda: Bank(folder), path)
    elif case == "id":
        refused(Bank(folder).read, folder / "segments")
    else:  # banks of before have none
        assert torch.equal(Bank(folder).read().theta[::5, 0], torch.arange(4.0))


@ATTACKS.add("a huge or strange file as header", cases=("sparse", "pipe", "device"))
def strange(case: str) -> None:
    folder = filled()
    path = folder / "bank.json"
    path.unlink()
    if case == "sparse":
        with path.open("wb") as file:
            file.truncate(2**40)
    elif case == "pipe":
        os.mkfifo(path)
    else:
        path.symlink_to("/dev/zero")
    refused(lambda: Bank(folder), path)


def _first(column: str, value: Any) -> Callable[[Any, Any], None]:
    return lambda columns, meta: columns[column].__setitem__(0, value)


def _whole(column: str, value: Any) -> Callable[[Any, Any], None]:
    return lambda columns, meta: columns.__setitem__(column, value)


def _meta(key: str, value: Any) -> Callable[[Any, Any], None]:
    return lambda columns, meta: meta.__setitem__(key, value)


def _run(**values: Any) -> Callable[[Any, Any], None]:
    return _meta("runs", [{"digest": "", "seed": 0, "label": "", **values}])


CRAFTED: dict[str, Callable[[Any, Any], None]] = {
    "-5 rows": _meta("num_rows", -5),
    "1e18 rows": _meta("num_rows", 10**18),
    "rows as text": _meta("num_rows", "5"),
    "rows as a float": _meta("num_rows", 5.0),
    "no runs": _meta("runs", []),
    "runs of nothing": _meta("runs", [{}]),
    "runs as a number": _meta("runs", 3),
    "a seed of a text": _run(seed="1"),
    "a seed of NaN": _run(seed=float("nan")),
    "a label of a list": _run(label=["prior"]),
    "other counts": _meta("counts", [0, 5, 0]),
    "negative counts": _meta("counts", [10, -5, 0]),
    "four counts": _meta("counts", [5, 0, 0, 0]),
    "300 deep": _meta("numbers", json.loads("[" * 300 + "]" * 300)),
    "an outcome of 7": _first("status", 7),
    "a run of -1": _first("run", -1),
    "a run of 9": _first("run", 9),
    "an index of -1": _first("index", -1),
    "a short column": _whole("x", np.zeros((2, 2), np.float32)),
    "a narrow column": _whole("x", np.zeros((5, 1), np.float32)),
    "float64": _whole("x", np.zeros((5, 2))),
    "complex": _whole("x", np.zeros((5, 2), np.complex64)),
    "a number": _whole("x", np.float32(3)),
    "texts": _whole("x", np.array([b"abc"] * 5)),
}


@ATTACKS.add("a crafted segment with right checksums", cases=tuple(CRAFTED))
def crafted(case: str) -> None:
    folder = filled()
    path = segment(folder, 2)
    columns, meta = read_segment(path, None)
    meta = {key: meta[key] for key in meta.keys() - {"shapes", "checksums"}}
    CRAFTED[case](columns, meta)
    write_segment(path, columns, meta)
    bank = Bank(folder)
    refused(lambda: bank.columns("x", "status", "seed", "index", "label"), path)
    assert any(str(path) in line for line in bank.verify())


def _other(make: Callable[[h5py.File], Any]) -> Callable[[h5py.File], Any]:
    def change(file: h5py.File) -> None:
        del file["x"]
        make(file)

    return change


def _objects(file: h5py.File) -> None:
    file.create_dataset("x", data=[["a", "b"]] * 5, dtype=h5py.string_dtype())


def _pickles(file: h5py.File) -> None:
    void = np.void(pickle.dumps(_Executed()))
    file.create_dataset("x", data=np.array([[void, void]] * 5))


class _Executed:
    """Leaves a file where somebody unpickles it."""

    def __reduce__(self) -> Any:
        return os.mkdir, ("executed",)


def _x(**options: Any) -> Callable[[h5py.File], Any]:
    return _other(lambda file: file.create_dataset("x", **options))


HDF5: dict[str, Callable[[h5py.File], Any]] = {
    "link to a file": _other(lambda f: f.__setitem__("x", h5py.ExternalLink("a", "x"))),
    "link to itself": _other(lambda f: f.__setitem__("x", h5py.SoftLink("/x"))),
    "link within": _other(lambda f: f.__setitem__("x", h5py.SoftLink("/theta"))),
    "a group": _other(lambda f: f.create_group("x")),
    "stored elsewhere": _x(
        shape=(5, 2), dtype="f4", external=[("/etc/passwd", 0, h5py.h5f.UNLIMITED)]
    ),
    "a filter": _x(data=np.zeros((5, 2), "f4"), compression="gzip"),
    "objects": _other(_objects),
    "pickles": _other(_pickles),
    "nothing": _x(data=h5py.Empty("f4")),
    "4 PB of nothing": _x(shape=(5, 10**14), dtype="f4", chunks=(1, 10**4)),
    "checksum of numbers": lambda f: f.attrs.__setitem__("sha256", [1, 2]),
    "no checksum": lambda f: f.attrs.__delitem__("sha256"),
}


@ATTACKS.add("HDF5 that no bank writes", cases=tuple(HDF5), seconds=60)
def hdf5(case: str) -> None:
    folder = filled()
    with h5py.File(segment(folder, 2), "r+") as file:
        HDF5[case](file)
    refused(lambda: Bank(folder).columns("x"), segment(folder, 2))
    assert not Path("executed").exists()


@ATTACKS.add("bits are flipped", cases=range(8), seconds=600)
def flipped(case: int) -> None:
    folder = filled(seeds=(0, 1))
    expected = Bank(folder).read()
    for path in (segment(folder, 2), folder / "bank.json"):
        content = path.read_bytes()
        for place in range(case, len(content), 64):
            damaged = bytearray(content)
            damaged[place] ^= 1 << random.Random(place).randrange(8)
            path.write_bytes(damaged)
            _same_or_refused(folder, expected)
        path.write_bytes(content)


@ATTACKS.add("files are cut", cases=range(4), seconds=600)
def cut(case: int) -> None:
    folder = filled(seeds=(0, 1))
    expected = Bank(folder).read()
    for path in (segment(folder, 2), folder / "bank.json"):
        content = path.read_bytes()
        for length in range(case, len(content) - 1, 64):
            path.write_bytes(content[:length])
            refused(lambda: Bank(folder).read(), folder)
        path.write_bytes(content)
    assert torch.equal(Bank(folder).read().x, expected.x)


def _same_or_refused(folder: Path, expected: Simulations) -> None:
    try:
        rows = Bank(folder).read()
    except CorruptSegmentError:
        return
    except ValueError as error:  # a flipped digit is another format
        if "expected a bank of format 1" not in str(error):
            raise
        return
    assert torch.equal(rows.x, expected.x)
    assert torch.equal(rows.theta, expected.theta)

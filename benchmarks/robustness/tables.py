"""Attacks on the readers of trials: names, cells, units, encodings and stamps."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from benchmarks.robustness.attacks import Attacks
from sbi_active.criticism import Trials

ATTACKS = Attacks()
HEAD = "trial,time,action_v,x_h\n"


def long(**changes: Any) -> pd.DataFrame:
    """Return a long table of two trials with two samples each."""
    columns = {
        "trial": ["a"] * 2 + ["b"] * 2,
        "time": [0.0, 1.0, 0.0, 1.0],
        "action_v": 1.0,
        "x_h": [0.1, 0.2, 0.3, 0.4],
    }
    return pd.DataFrame({**columns, **changes})


def read(content: str | bytes) -> Trials:
    """Write a file and read its trials."""
    data = content.encode() if isinstance(content, str) else content
    Path("t.csv").write_bytes(data)
    return Trials.from_csv("t.csv")


def times_of(trials: Trials) -> list[float]:
    """Return the times of two trials, one after the other."""
    assert trials.sample_times is not None
    return trials.sample_times.expand(2, -1).flatten().tolist()


def numbers(trials: Trials) -> list[float]:
    """Return the outcomes in the order of the table."""
    return [round(v, 6) for v in trials.x.flatten().tolist()]


NAMES = (
    ["run#1", "run#2"],
    ["1", "01"],
    ["1.0", "1.00"],
    ["a ", "b"],
    ["Ä", "A"],
    ["true", "True"],
    ["2026-11-01", "2026-11-02"],
    ["20261101", "20261102"],
    ["1e3", "1000"],
    ["0x10", "16"],
    ["a;b", "a"],
    ["Nones", "nones"],
    ["-1", "1"],
    ["inf", "infinity"],
)


@ATTACKS.add("names of trials in a file", cases=[tuple(n) for n in NAMES])
def names(given: tuple[str, str]) -> None:
    first, second = given
    trials = read(
        f"{HEAD}{first},0,1,.1\n{first},1,1,.2\n{second},0,1,.3\n{second},1,1,.4\n"
    )
    assert len(trials.x) == 2, trials.names
    assert len(set(trials.names or ())) == 2, trials.names
    assert numbers(trials) == [0.1, 0.2, 0.3, 0.4]


@ATTACKS.add(
    "numbers that name trials",
    cases=[
        (20261101.0, 20261102.0),
        (1.0, 2.0),
        (0.1, 0.1000001),
        (1e15, 1e15 + 1),
        (1e300, 1.1e300),
        (-1.0, 1.0),
        (0.0, 1e-300),
        (2**53, 2**53 - 1),
    ],
)
def ids(given: tuple[float, float]) -> None:
    trials = Trials.from_dataframe(long(trial=np.repeat(given, 2)))
    assert len(trials.x) == 2
    assert len(set(trials.names or ())) == 2, trials.names


@ATTACKS.add(
    "stamps",
    cases=[
        (unit, zone, step)
        for unit in ("s", "ms", "us", "ns")
        for zone in (None, "UTC", "Europe/Berlin")
        for step in (1_000, 2_000)
    ],
)
def stamps(case: tuple[str, str | None, int]) -> None:
    unit, zone, step = case
    day = np.datetime64("2026-10-25T00:00:00")
    at = day + np.array([0, step, 9_000, 9_000 + step]).astype("timedelta64[ms]")
    column = pd.Series(at.astype(f"datetime64[{unit}]"))
    if zone:
        column = column.dt.tz_localize("UTC").dt.tz_convert(zone)
    trials = Trials.from_dataframe(long(time=column))
    times = times_of(trials)
    assert np.allclose(times, [0.0, step / 1e3] * 2), times


@ATTACKS.add(
    "units of the time's column",
    cases=[
        (name, factor)
        for name, factor in (
            ("time", 1.0),
            ("time [s]", 1.0),
            ("time_s", 1.0),
            ("time [ms]", 1e3),
            ("time_ms", 1e3),
            ("time[us]", 1e6),
            ("time_ns", 1e9),
            ("time [ns]", 1e9),
        )
    ],
)
def units(case: tuple[str, float]) -> None:
    name, factor = case
    times = [0.0, 0.5 * factor, 0.0, 0.5 * factor]
    trials = Trials.from_dataframe(long(time=times).rename(columns={"time": name}))
    found = times_of(trials)
    assert np.allclose(found, [0, 0.5, 0, 0.5]), found


ROWS = "a,0,1,.1\na,1,1,.2\nb,0,1,.3\nb,1,1,.4\n"
FILES: dict[str, bytes] = {
    "plain": (HEAD + ROWS).encode(),
    "byte order mark": b"\xef\xbb\xbf" + (HEAD + ROWS).encode(),
    "CRLF": (HEAD + ROWS).replace("\n", "\r\n").encode(),
    "CR": (HEAD + ROWS).replace("\n", "\r").encode(),
    "no last newline": (HEAD + ROWS).rstrip().encode(),
    "empty lines": (HEAD + "\n\n" + ROWS).encode(),
    "comment lines": ("# made by hand\n" + HEAD + "# one\n" + ROWS).encode(),
    "spaces": (HEAD + ROWS.replace(",", ", ")).encode(),
    "quoted": (HEAD + ROWS.replace("a,", '"a",')).encode(),
    "semicolons": (HEAD + ROWS).replace(",", ";").encode(),
    "tabs": (HEAD + ROWS).replace(",", "\t").encode(),
    "UTF-16": (HEAD + ROWS).encode("utf-16"),
    "Latin-1": (HEAD + ROWS).replace("a,", "\xe4,").encode("latin-1"),
    "empty": b"",
    "head alone": HEAD.encode(),
    "NULs": b"\0" * 100,
    "a picture": b"\x89PNG\r\n\x1a\n" + bytes(range(256)),
    "short row": (HEAD + ROWS + "b,2\n").encode(),
    "long row": (HEAD + ROWS + "b,2,1,.5,9,9\n").encode(),
    "decimal comma": (HEAD + ROWS.replace(".", "0,")).encode(),
    "decimal comma, semicolons": (HEAD + ROWS)
    .replace(",", ";")
    .replace(".", "0,")
    .encode(),
    "text in a cell": (HEAD + ROWS.replace(".2", "n/a?")).encode(),
    "unit in a cell": (HEAD + ROWS.replace(".2", ".2 m")).encode(),
    "complex": (HEAD + ROWS.replace(".2", "1+2j")).encode(),
    "infinite": (HEAD + ROWS.replace(".2", "inf")).encode(),
    "1e39": (HEAD + ROWS.replace(".2", "1e39")).encode(),
    "true": (HEAD + ROWS.replace(".2", "True")).encode(),
    "a column twice": (
        HEAD.replace("x_h", "x_h,x_h") + ROWS.replace("\n", ",9\n")
    ).encode(),
    "no column of x": (HEAD.replace("x_h", "h") + ROWS).encode(),
    "time backwards": (HEAD + ROWS.replace("a,1,", "a,-1,")).encode(),
    "time NaN": (HEAD + ROWS.replace("a,1,", "a,nan,")).encode(),
    "action changes": (HEAD + ROWS.replace("a,1,1,", "a,1,2,")).encode(),
}


@ATTACKS.add("files", cases=list(FILES))
def files(name: str) -> None:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            trials = read(FILES[name])
    except ValueError as error:
        text = str(error)
        assert "expected" in text or "t.csv" in text, text
        return
    found = numbers(trials)
    assert found == [0.1, 0.2, 0.3, 0.4], found


@ATTACKS.add("a missing cell", cases=("", "nan", "NaN", "NA", "null", "None", "-"))
def missing(cell: str) -> None:
    try:
        trials = read(HEAD + ROWS.replace(".2", cell))
    except ValueError as error:
        assert "expected" in str(error), error
        return
    assert trials.mask is not None
    mask = [bool(v) for v in trials.mask.flatten().tolist()]
    assert mask == [True, False, True, True], mask


@ATTACKS.add("a folder of recordings", cases=("._", ".", "~", "with others"))
def folder(kind: str) -> None:
    place = Path("runs")
    place.mkdir()
    for k in (1, 2):
        (place / f"run_{k}.csv").write_text(f"time,action_v,x_h\n0,1,.1\n1,1,.{k}\n")
    if kind == "with others":
        (place / "notes.txt").write_text("hello")
    else:
        (place / f"{kind}run_1.csv").write_bytes(b"\x00\x05\x16\x07")
    try:
        trials = Trials.from_csv(place)
    except ValueError as error:
        assert f"{kind}run_1.csv" in str(error), error
        return
    assert trials.names == ("run_1", "run_2")


@ATTACKS.add(
    "cells of a frame",
    cases=(
        "complex",
        "object",
        "bool",
        "string",
        "int64",
        "float16",
        "decimal",
        "dates",
    ),
)
def cells(kind: str) -> None:
    from decimal import Decimal

    given: dict[str, Any] = {
        "complex": [1 + 1j, 2, 3, 4],
        "object": [object(), 0.2, 0.3, 0.4],
        "bool": [True, False, True, False],
        "string": ["0.1", "0.2", "0.3", "0.4"],
        "int64": [2**60, 2, 3, 4],
        "float16": np.array([0.125, 0.25, 0.5, 1.0], dtype=np.float16),
        "decimal": [Decimal("0.1"), Decimal("0.2"), Decimal("0.3"), Decimal("0.4")],
        "dates": pd.to_datetime(["2026-01-01"] * 4),
    }
    try:
        trials = Trials.from_dataframe(long(x_h=given[kind]))
    except (ValueError, TypeError) as error:
        assert "expected" in str(error), error
        return
    expected = [float(v) for v in given[kind]]
    assert np.allclose(trials.x.flatten().tolist(), expected, rtol=1e-6)

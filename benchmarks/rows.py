"""Rows of results in CSV and JSON files, to which resumable benchmarks add."""

from __future__ import annotations

import csv
import json
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from torch import Tensor

T = TypeVar("T")
Row = Mapping[str, Any]


def read(path: Path) -> list[dict[str, str]]:
    """Return the rows of a CSV file, none if it is not there."""
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return [*csv.DictReader(file)]


def append(path: Path, columns: Sequence[str], rows: Sequence[Row]) -> None:
    """Add rows to a CSV file, which is begun with its header, six digits a number."""
    path.parent.mkdir(parents=True, exist_ok=True)
    is_new = not path.exists()
    with path.open("a", newline="") as file:
        writer = csv.DictWriter(file, columns, lineterminator="\n")
        if is_new:
            writer.writeheader()
        writer.writerows({k: short(v) for k, v in row.items()} for row in rows)


def resumed(
    path: Path,
    keys: Sequence[str],
    jobs: Iterable[Sequence[Any]],
    make: Callable[..., Row | Sequence[Row]],
    *,
    columns: Sequence[str] | None = None,
    others: Sequence[Path] = (),
) -> list[dict[str, str]]:
    """Add the rows of jobs that a CSV file does not have yet, and return all its rows.

    Args:
        path: Path of the file.
        keys: Columns that tell jobs apart.
        jobs: Values of these columns, which are the arguments of ``make``.
        make: Function that returns the row, or the rows, of a job.
        columns: Columns of the file; those of the first row by default.
        others: Further files, whose rows are not made again either.
    """
    known = [row for own in (path, *others) for row in read(own)]
    done = {tuple(row[key] for key in keys) for row in known}
    for job in jobs:
        if tuple(map(str, job)) in done:
            continue
        start = time.process_time()
        made = make(*job)
        rows = [made] if isinstance(made, Mapping) else [*made]
        append(path, columns or [*rows[0]], rows)
        said = rows[-1].get("failure") or rows[-1].get("verdict") or ""
        spent = f"{time.process_time() - start:.0f} CPU s"
        print(path.stem, *job, said, spent, flush=True)
    return read(path)


def or_failure(make: Callable[[], Row]) -> Row:
    """Return a row, or the column "failure" alone: a crash is a result too."""
    try:
        return make()
    except Exception as error:
        return {"failure": f"{type(error).__name__}: {error}"[:300]}


def column(rows: Sequence[Row], key: str, round_: int | None = None) -> np.ndarray:
    """Return a column of one round, or of all, as numbers; NaN where it is empty."""
    kept = [r[key] for r in rows if round_ is None or int(r["round"]) == round_]
    return np.array([float(v) if v else np.nan for v in kept])


def grouped(rows: Iterable[Row], *keys: str) -> dict[tuple[Any, ...], list[Any]]:
    """Return rows by the values of some columns, in the order of the first of each."""
    groups: dict[tuple[Any, ...], list[Any]] = {}
    for row in rows:
        groups.setdefault(tuple(row[key] for key in keys), []).append(row)
    return groups


def short(value: object) -> object:
    """Return a number with six digits."""
    return f"{float(value):.6g}" if isinstance(value, (float, Tensor)) else value


def stages(path: Path) -> dict[str, Any]:
    """Return the stages of a JSON file by name, none if it is not there."""
    return json.loads(path.read_text()) if path.is_file() else {}


def keep(path: Path, rows: Mapping[str, Any]) -> None:
    """Write all stages of a JSON file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(rows, indent=1) + "\n")


def measured(read_data: Callable[..., T], *arguments: Any) -> T:
    """Return measured data, or end the process where they are not there."""
    try:
        return read_data(*arguments)
    except FileNotFoundError as error:
        raise SystemExit(f"{error}, as in --data DIR") from None

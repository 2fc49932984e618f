"""Rows of results in CSV files, to which resumable benchmarks add."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path

from torch import Tensor


def read(path: Path) -> list[dict[str, str]]:
    """Return the rows of a CSV file, none if it is not there."""
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return [*csv.DictReader(file)]


def append(
    path: Path, columns: Sequence[str], rows: Sequence[Mapping[str, object]]
) -> None:
    """Add rows to a CSV file, which is begun with its header, six digits a number."""
    path.parent.mkdir(parents=True, exist_ok=True)
    is_new = not path.exists()
    with path.open("a", newline="") as file:
        writer = csv.DictWriter(file, columns, lineterminator="\n")
        if is_new:
            writer.writeheader()
        writer.writerows({k: short(v) for k, v in row.items()} for row in rows)


def short(value: object) -> object:
    """Return a number with six digits."""
    return f"{float(value):.6g}" if isinstance(value, (float, Tensor)) else value

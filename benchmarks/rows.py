"""Rows of results in CSV and JSON files, to which resumable benchmarks add."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from torch import Tensor

T = TypeVar("T")


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

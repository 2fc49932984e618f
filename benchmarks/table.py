"""Print a committed CSV or JSON file as a table.

    python -m benchmarks table information_gain/peers.csv
    python -m benchmarks table cost/doors.json --only "cpu_s*"
    python -m benchmarks table readme    # README's; exits 1 where it misses a value

A file of rows keeps its columns, or those named by ``--columns``. Of nested values each
number is a row, called by its path; ``--only`` keeps paths that match a pattern.
"""

import csv
import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

from benchmarks import readme
from sbi_active.display.table import Table

HERE = Path(__file__).parent
LONGEST = 30  # characters of a text that calls a row; a longer one is a note


def leaves(value: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[str, str]]:
    """Yield each number or text of nested values with its path.

    Example:
        >>> [*leaves({"cpu": {"ours": 1.25}, "runs": [{"on": "disk", "s": 3}]})]
        [('cpu, ours', '1.25'), ('runs, disk, s', '3')]
    """
    if isinstance(value, dict):
        for name, part in value.items():
            yield from leaves(part, (*path, name))
    elif isinstance(value, list):
        for number, part in enumerate(value):
            names = [str(number)]
            if isinstance(part, dict):  # called by its words
                words = {k: v for k, v in part.items() if isinstance(v, str)}
                short = {k: v for k, v in words.items() if len(v) <= LONGEST}
                names = [*short.values()] or names
                part = {k: v for k, v in part.items() if k not in short}
            yield from leaves(part, (*path, *names))
    else:
        shown = f"{value:.4g}" if isinstance(value, float) else str(value)
        yield ", ".join(path), shown


@dataclass(frozen=True)
class Settings:
    """What is run.

    Args:
        file: Path of the file below benchmarks/; ``readme`` is README's own table.
        only: Patterns of paths; all by default.
        columns: Names of columns of a CSV file; all by default.
    """

    file: str
    only: Sequence[str] = ("*",)
    columns: Sequence[str] | None = None


def main(arguments: Settings) -> int:
    """Print the table."""
    if arguments.file == "readme":
        lines, misses = readme.table()
        print(*lines, sep="\n")
        print(*misses, sep="\n", file=sys.stderr)
        return 1 if misses else 0
    path = HERE / arguments.file
    if path.suffix == ".csv":
        with path.open(newline="") as file:
            rows = [*csv.DictReader(file)]
        header = arguments.columns or [*rows[0]]
        cells = [[row[name] for name in header] for row in rows]
    else:
        header = ["what", "value"]
        cells = [
            [name, value]
            for name, value in leaves(json.loads(path.read_text()))
            if any(fnmatch(name, pattern) for pattern in arguments.only)
        ]
    print(Table(header, cells).markdown())
    return 0

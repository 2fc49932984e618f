"""Numbers as people write them: in words, and in tables."""

from __future__ import annotations

import csv
import io
import math
import re
from pathlib import Path
from typing import Any

#: What float32 holds with all its digits, beside 0.
SMALLEST, LARGEST = 2.0**-126, 2.0**128 - 2.0**104


def flat(value: Any) -> list[Any]:
    """Return the parts of nested lists."""
    if not isinstance(value, list):
        return [value]
    return [part for item in value for part in flat(item)]


def number_of(cell: str, place: str = "", *, is_outcome: bool = False) -> float:
    """Return a number as written, which float32 has to hold.

    Args:
        cell: The number; nan in an outcome.
        place: Place where it stands, for the error.
        is_outcome: Whether it may be one that was not measured.

    Raises:
        ValueError: If it is anything else.
    """
    try:
        value = math.nan if "_" in cell else float(cell)
    except ValueError:
        value = math.inf
    if value == 0 or SMALLEST <= abs(value) <= LARGEST:
        return value
    if is_outcome and cell.strip().lower() == "nan":
        return math.nan
    raise ValueError(
        f"expected finite numbers; got {cell!r:.80}{place}; write them with a point, "
        "as in 1.5 or 2e-3, without a unit, and within the range of float32"
    )


def numbers_in(path: Path) -> list[float]:
    """Return the numbers of a file; an empty cell of a row was not measured.

    Raises:
        ValueError: If it is no table of numbers.
    """
    try:
        content = io.StringIO(path.read_text(encoding="utf-8-sig"), newline="")
        rows = [*csv.reader(content, strict=True)]
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(
            f"expected a table of numbers, as text in UTF-8; got {path} ({error}); "
            "save it so"
        ) from error
    # A heading has no cell that begins like a number: 0.84 m and 0,84;1 are none.
    begins = re.compile(r"\s*(?:[-+]?\.?\d|[-+]?(?:nan|inf)\b|$)", re.IGNORECASE)
    first = 1 if rows and not any(map(begins.match, rows[0])) else 0
    return [
        number_of(cell.strip() or "nan", f" in row {i} of {path}", is_outcome=True)
        for i, row in enumerate(rows[first:], start=first + 1)
        for cell in row
    ]

"""What papers report, from ``published.csv``: table, row, values and source."""

import csv
from pathlib import Path

FILE = Path(__file__).with_name("published.csv")


def published(table: str) -> dict[str, tuple[str, ...]]:
    """Return the rows of a table, by name, each with its values in the file's order."""
    with FILE.open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["table"] == table]
    return {
        row["row"]: tuple(value.strip() for value in row["values"].split(";"))
        for row in rows
    }

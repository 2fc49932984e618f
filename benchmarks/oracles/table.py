"""Tables of the oracles' rows: problem by way."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from sbi_active.display.table import Table
from tests.oracles.problems import PROBLEMS
from tests.oracles.ways import WAYS

Row = dict[str, str]


def divergence(row: Row) -> str:
    """Return the divergence of a belief, and what it says where it is wrong."""
    if row.get("error"):
        return row["error"].partition(" ")[0]
    shown = f"{float(row['kl']):.2g}"
    if not set(row["faults"].split()) - {"evidence"}:
        return shown + (" ?" if row["trustworthy"] == "False" else "")
    says = {"True": "wrong, says True", "False": "wrong, says so", "": "wrong"}
    return f"{shown} {says[row['trustworthy']]}"


def evidence(row: Row) -> str:
    """Return the error of a log evidence, in standard errors."""
    has_none = row.get("error") or row.get("evidence") in (None, "", "nan")
    return "" if has_none else f"{float(row['evidence']):.1f}"


def cost(row: Row) -> str:
    """Return simulated rows and CPU seconds."""
    return f"{int(row['rows']):,}; {float(row['cpu_seconds']):.1f}"


def text(rows: Sequence[Row]) -> str:
    """Return all tables as Markdown.

    Args:
        rows: As in ``rows.csv``.
    """
    header = ("problem", "parameters", "numbers a trial", "what makes it hard")
    hard = [
        (name, fn().dim, fn().x.shape[1], fn().hard) for name, fn in PROBLEMS.items()
    ]
    return "\n\n".join(
        [
            Table(header, hard).markdown(),
            'KL divergence of normal fits, nats ("?": right, and says False):',
            crossed(rows, divergence),
            "Error of the log evidence in standard errors:",
            crossed([row for row in rows if evidence(row)], evidence),
            "Simulated rows and CPU seconds:",
            crossed(rows, cost),
        ]
    )


def crossed(rows: Sequence[Row], cell: Callable[[Row], str]) -> str:
    """Return a Markdown table, a problem a line and a way a column.

    Args:
        rows: Rows of the first seed of each problem and way.
        cell: What is shown of a row.
    """
    known = {(row["problem"], row["way"]): cell(row) for row in reversed(rows)}
    ways = [way for way in WAYS if any(w == way for _, w in known)]
    lines = []
    for problem in PROBLEMS:
        if any(p == problem for p, _ in known):
            lines.append([problem, *(known.get((problem, way), "") for way in ways)])
    return Table(["problem", *ways], lines).markdown()

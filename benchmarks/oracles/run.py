"""Every way to a belief or an evidence on every problem with a known answer.

Problems, ways and limits are those of ``tests/oracles``; nothing may be tuned on them.
Resumable: a problem and way that stand in ``rows.csv`` are not run again.

Tables of the oracles' rows: problem by way.
"""

from __future__ import annotations

import time
import traceback
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path

import torch

from benchmarks.rows import benchmark
from sbi_active.display.table import Table
from tests.oracles.judging import judged
from tests.oracles.problems import PROBLEMS
from tests.oracles.reference import answers
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


def row_of(problem: str, way: str, seed: int) -> dict[str, object]:
    """Return the error of one way on one problem, its cost and what it says.

    Args:
        problem: Name of a problem.
        way: Name of a way.
        seed: Seed of the way.
    """
    (own, num_rows), used = PROBLEMS[problem]().counted(), WAYS[way]
    simulator = own.simulator(is_declared=used.is_declared)
    row: dict[str, object] = {}
    start = time.process_time()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            torch.manual_seed(seed)
            found = used.run(own, simulator, seed)
    except Exception as error:  # a row of the table as well
        where = traceback.extract_tb(error.__traceback__)[-1].name
        row |= {"error": f"{type(error).__name__} in {where}: {str(error)[:120]}"}
    else:
        row |= {"trustworthy": found.trustworthy}
        result = judged(own, answers()[problem], found)
        row |= {**vars(result), "faults": " ".join(result.faults())}
    cpu = time.process_time() - start
    return {**row, "rows": sum(num_rows), "cpu_seconds": round(cpu, 2)}


main = benchmark(
    Path(__file__).with_name("rows.csv"),
    row_of,
    text,
    skip=lambda problem, way, seed: not WAYS[way].claims(PROBLEMS[problem]()),
    problem=PROBLEMS,
    way=WAYS,
    seed=range(1),
)

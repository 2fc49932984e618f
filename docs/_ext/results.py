"""Write the tables of the committed rows, as the benchmarks' own commands print them.

Nothing is run again: each command reads its files. No figure of these is typed. Each
section's tables are a file, which ``docs/benchmarks.md`` includes.
"""

import contextlib
import io
import re
import runpy
import sys
from collections.abc import Iterable
from itertools import pairwise
from pathlib import Path
from unittest import mock

from sphinx.application import Sphinx

ROOT = Path(__file__).parents[2]
PAGES = ROOT / "docs" / "reference" / "api" / "results"
EMPTY = re.compile(r"nan( (/|\+-) nan)*")
#: Sections of docs/benchmarks.md, and the commands that print their tables.
TABLES = {
    "The paper's numerical model": (
        "benchmarks.numerical.run --summary",
        "benchmarks.numerical.run --summary --trials 60 --settings default "
        "--methods asbi",
        "benchmarks.numerical.run --summary --truth random --trials 40 "
        "--settings default --methods asbi",
        "benchmarks.numerical.run --summary --task sinh "
        "--settings default default_500 --methods asbi",
        "benchmarks.numerical.run --summary --task square "
        "--settings default default_500 --methods asbi",
        "benchmarks.numerical.run --summary --task oscillator --truth random "
        "--settings default default_500 --methods asbi",
        "benchmarks.numerical.run --summary --task oscillator --truth random "
        "--jitter 0.1 --settings default --methods asbi",
    ),
    "Table 1 of the paper": (
        "benchmarks.numerical.methods --summary --setting faithful",
        "benchmarks.numerical.methods --summary --setting default",
    ),
    "Expected information gain": ("benchmarks.table information_gain/result.csv",),
    "Beside pyro.contrib.oed": ("benchmarks.table information_gain/peers.csv",),
    "Continuous and mixed actions": (
        "benchmarks.search.run --summary",
        "benchmarks.search.run --summary --cases mixed --first 40",
    ),
    "Source location finding": ("benchmarks.location_finding.summary",),
    "The simulation engine": (
        "benchmarks.table engine/result.json --only *overhead,*overhead,*median* "
        "workers,*speedup*median faults,*",
    ),
    "What an adversary found": (
        "benchmarks.robustness.run --summary",
        "benchmarks.robustness.exact --summary",
        "benchmarks.robustness.exact --summary --histories 200",
        "benchmarks.robustness.outliers --summary",
        "benchmarks.robustness.health --summary",
    ),
    "Campaigns on disk": (
        "benchmarks.table cost/directory.json --only tell* load,* *near*",
        "benchmarks.table robustness/results/units.json --only [!r]*",
    ),
    "Box collision": (
        "benchmarks.box_collision.run --summary",
        "benchmarks.box_collision.run --summary --table coverage --rounds 3",
        "benchmarks.box_collision.run --summary --setting learned "
        "--methods asbi nsbi alhi nlhi --trials 10",
        "benchmarks.table box_collision/speed.json",
    ),
    "The closed loop, on worlds whose truth is known": (
        *(
            f"benchmarks.criticism.run --summary --table loop --world {world}"
            for world in "ABCD"
        ),
        *(
            f"benchmarks.criticism.run --summary --table {table} --world {world} "
            "--trials 12"
            for table in ("open", "pairs")
            for world in "AB"
        ),
        "benchmarks.criticism.run --summary --table active --world A",
        *(
            f"benchmarks.criticism.run --summary --table priors --world A --scale {by}"
            for by in ("3", "0.3333333")
        ),
        "benchmarks.criticism.run --summary --table loop --world C --kind clean "
        "--independent",
        "benchmarks.criticism.campaign --summary",
        "benchmarks.criticism.campaign --summary --policy check",
    ),
    "Verdicts where every model is wrong": (
        "benchmarks.misfit.run --summary",
        "benchmarks.misfit.odds --table",
        "benchmarks.misfit.start_states --summary",
    ),
    "Forces that nobody declared": ("benchmarks.forces.run --summary",),
    "Robots from their MJCF": (
        "benchmarks.robots.hidden show",
        "benchmarks.robots.coverage show",
        "benchmarks.robots.excitation --summary",
    ),
    "A chain of many parameters": (
        "benchmarks.chain.run --summary",
        "benchmarks.chain.run --campaign --summary",
    ),
    "Bad networks and beliefs flagged": ("benchmarks.calibration.run --summary",),
    "Every way to a belief, where the answer is known": (
        "benchmarks oracles --summary",
        "benchmarks oracles.calibration --summary",
    ),
    "Dear simulators": ("benchmarks.dear.run --table",),
    "The cost of a round": (
        "benchmarks.table cost/result.json",
        "benchmarks.table cost/network.json",
        "benchmarks.table cost/doors.json --only cpu_s*",
    ),
    "Robust updates": ("benchmarks.chain.robust --summary",),
    "sbi's own tests with the class swapped": (
        "benchmarks.table sbi_suite/result.json --only date sbi original* swapped*",
    ),
    "Pouring": (
        "benchmarks.pouring.run --summary",
        "benchmarks.pouring.around --summary",
        "benchmarks.pouring.refined --summary",
        "benchmarks.pouring.material.run --summary",
        "benchmarks.pouring.loop.run --summary",
    ),
}


def printed(command: str) -> str:
    """Return what a command prints, run in this process."""
    module, *_ = argv = command.split()
    text = io.StringIO()
    path = [str(ROOT), *sys.path]
    with (
        mock.patch.object(sys, "argv", argv),
        mock.patch.object(sys, "path", path),
        contextlib.redirect_stdout(text),
    ):
        try:
            runpy.run_module(module, run_name="__main__")
        except SystemExit as done:  # the one command for all benchmarks
            if done.code:
                raise
        except FileNotFoundError:  # rows that are being made again
            return "No rows are committed now."
    if not text.getvalue().strip():
        raise ValueError(f"expected a table of {command}; got nothing; commit its rows")
    return text.getvalue()


def as_markdown(text: str) -> str:
    """Return printed lines with their tables as Markdown; all else as it stands."""
    lines: list[str] = []
    given = [*text.splitlines(), ""]
    number, plain = 0, []

    def flush() -> None:
        while plain and not plain[-1].strip():
            plain.pop()
        if any(line.strip() for line in plain):
            lines.extend(["```text", *plain, "```", ""])
        plain.clear()

    while number < len(given):
        line = given[number]
        rule = given[number + 1] if number + 1 < len(given) else ""
        if re.fullmatch(r"-{2,}(  -+)+", rule):
            flush()
            rows, number = [line], number + 2
            while given[number] and in_columns(given[number], rule):
                rows.append(given[number])
                number += 1
            lines += [*table([cells(row, rule) for row in rows]), ""]
            continue
        if line.startswith("|"):
            flush()
            while given[number].startswith("|"):
                lines.append(given[number])
                number += 1
            lines.append("")
            continue
        if line.startswith("## "):
            flush()
            lines += [f"**{line.removeprefix('## ')}**", ""]
        elif line.strip() or plain:
            plain.append(line)
        number += 1
    flush()
    return "\n".join(lines)


def in_columns(row: str, rule: str) -> bool:
    """Return whether a line keeps the gaps between the columns free."""
    return all(a == "-" or b == " " for a, b in zip(rule, row, strict=False))


def cells(row: str, rule: str) -> list[str]:
    """Return the cells of a row, by the columns of the rule under its header."""
    starts = [m.start() for m in re.finditer(r"-+", rule)] + [None]
    found = [row[a:b].strip() for a, b in pairwise(starts)]
    return ["" if EMPTY.fullmatch(cell) else cell for cell in found]


def table(rows: list[list[str]]) -> list[str]:
    """Return rows, the header first, as a Markdown table."""
    rows = [rows[0], ["---"] * len(rows[0]), *rows[1:]]
    return [
        "| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |"
        for row in rows
    ]


def file_of(title: str) -> Path:
    """Return the file of a section's tables."""
    return PAGES / f"{re.sub('[^a-z]+', '-', title.lower()).strip('-')}.txt"


def tables(commands: Iterable[str]) -> str:
    """Return tables, each under the command that printed it."""
    lines = ["::::{container} rows", ""]
    for command in commands:
        lines += [f"```bash\npython -m {command}\n```", ""]
        lines += [as_markdown(printed(command)), ""]
    return "\n".join([*lines, "::::", ""])


def _generate(app: Sphinx) -> None:
    PAGES.mkdir(parents=True, exist_ok=True)
    for title, commands in TABLES.items():
        path, text = file_of(title), tables(commands)
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


def setup(app: Sphinx) -> dict[str, bool]:
    """Write the tables before the pages are read."""
    app.connect("builder-inited", _generate)
    return {"parallel_read_safe": True, "parallel_write_safe": True}

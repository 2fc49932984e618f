"""Write the tables of the committed rows, as the benchmarks' own commands print them.

Nothing is run again: each command reads its files. No figure of these is typed. Each
section's tables are a file, which ``docs/benchmarks.md`` includes.
"""

import contextlib
import io
import re
import sys
from collections.abc import Iterable
from itertools import pairwise
from pathlib import Path

from sphinx.application import Sphinx

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT))
from benchmarks.__main__ import main as run_benchmark  # noqa: E402

PAGES = ROOT / "docs" / "reference" / "api" / "results"
EMPTY = re.compile(r"nan( (/|\+-) nan)*")
#: Sections of docs/benchmarks.md, and the commands that print their tables.
TABLES = {
    "The paper's numerical model": (
        "numerical --summary",
        "numerical --summary --seeds 0 200 --setting default --method asbi",
        "numerical --summary --truth random --seeds 0 40 "
        "--setting default --method asbi",
        "numerical --summary --task sinh --setting default default_500 --method asbi",
        "numerical --summary --task square --setting default default_500 --method asbi",
        "numerical --summary --task oscillator --truth random "
        "--setting default default_500 --method asbi",
        "numerical --summary --task oscillator_jittered --truth random "
        "--setting default --method asbi",
    ),
    "Table 1 of the paper": (
        "numerical.methods --summary --setting faithful",
        "numerical.methods --summary --setting default",
    ),
    "Expected information gain": ("table information_gain/result.csv",),
    "Continuous and mixed actions": (
        "search --summary",
        "search --summary --seeds 40 80",
    ),
    "Trials for a controller": ("target --summary",),
    "Source location finding": ("location_finding --summary",),
    "What an adversary found": (
        "robustness --summary",
        "robustness.health --summary",
    ),
    "Campaigns on disk": ("table cost/directory.json --only tell* load,*",),
    "Box collision": (
        "box_collision --summary",
        "box_collision --summary --setting coverage --target prior --seeds 0 40",
        "box_collision --summary --setting learned --method asbi nsbi alhi nlhi",
    ),
    "The closed loop, on worlds whose truth is known": (
        *(f"criticism --summary --world {world}" for world in "ABCD"),
        *(
            f"criticism --summary --kind {kinds} --world {world}"
            for kinds in ("removed inexpressible outside", "pair")
            for world in "AB"
        ),
        "criticism --summary --kind active --world A",
    ),
    "Verdicts where every model is wrong": (
        "misfit --summary",
        "misfit.metamorphic --summary",
    ),
    "Trials that decide": ("experiments --summary",),
    "May it go out?": ("experiments.gate --summary",),
    "Forces that nobody declared": ("forces --summary",),
    "Robots from their MJCF": (
        "robots.hidden --summary",
        "robots.coverage --summary",
        "robots.excitation --summary",
    ),
    "A chain of many parameters": ("chain --summary",),
    "Bad networks and beliefs flagged": (
        "calibration.networks --summary",
        "calibration.beliefs --summary",
    ),
    "Every way to a belief, where the answer is known": (
        "oracles --summary",
        "oracles.calibration --summary",
    ),
    "Dear simulators": ("dear --summary",),
    "The cost of a round": (
        "table cost/result.json",
        "table cost/network.json",
        "table cost/walls.json",
    ),
    "Robust updates": ("chain.robust --summary",),
    "sbi's own tests with the class swapped": (
        "table sbi_suite/result.json --only date sbi original* swapped*",
    ),
    "Pouring": ("pouring --summary", "pouring.material --summary"),
}


def printed(command: str) -> str:
    """Return what a benchmark prints, run in this process by its name and options."""
    text = io.StringIO()
    with contextlib.redirect_stdout(text):
        try:
            status = run_benchmark(command.split())
        except FileNotFoundError:  # rows that are being made again
            return "No rows are committed now."
    if status or not text.getvalue().strip():
        raise ValueError(
            f"expected a table of {command}; got {text.getvalue()!r} and the status "
            f"{status}; commit its rows"
        )
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
        lines += [f"```bash\npython -m benchmarks {command}\n```", ""]
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

"""Print a committed CSV or JSON file as a table.

    python -m benchmarks table information_gain/result.csv
    python -m benchmarks table cost/network.json --only "*ratio"
    python -m benchmarks table readme    # README's; exits 1 where it misses a value

A file of rows keeps its columns. Of nested values each number is a row, called by its
path; ``--only`` keeps paths that match a pattern.

README's table, from committed rows, beside the values that are stated of it.

    python -m benchmarks table readme

Each row of ``readme.toml`` names a function of ``FIGURES``, which returns the row's
figures. A figure below its ``least`` or above its ``most`` is a miss.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.rows import read, toml
from sbi_active.display.table import Table

HERE = Path(__file__).parent
STATED = HERE / "readme.toml"
HEADER = ["| what | result | beside it |", "|---|---|---|"]


def numerical() -> dict[str, float]:
    """Return the median log p(truth) after four trials, and the exact limit's."""
    folder = HERE / "numerical/results"
    rows = [
        r for r in read(folder / "linear_fixed_default_asbi.csv") if r["round"] == "4"
    ]
    exact = [r for r in read(folder / "exact.csv") if r["actions"] == "exact"]
    return {
        "found": median(rows, "log_prob_true"),
        "exact": median(exact, "log_prob_4"),
    }


def round_time() -> dict[str, float]:
    """Return CPU seconds of a round, the library's defaults and the paper's setting."""
    folder = HERE / "numerical/results"
    files = {"ours": "default", "paper": "faithful"}
    found = {}
    for name, setting in files.items():
        rows = read(folder / f"linear_fixed_{setting}_asbi.csv")
        stages = [key for key in rows[0] if key.startswith("cpu_")]
        found[name] = float(
            np.mean([sum(float(r[s] or 0) for s in stages) for r in rows])
        )
    return found


def training() -> dict[str, float]:
    """Return how many times longer a stock network trains on the same rows."""
    return {"ratio": load("cost/result.json")["ratio"]}


def box() -> dict[str, float]:
    """Return the median log p(truth) by target after chosen and random trials."""
    found = {}
    for policy, method in (("chosen", "asbi"), ("random", "nsbi")):
        for target in (1, 2):
            path = HERE / f"box_collision/results/default_target_{target}_{method}.csv"
            rows = [r for r in read(path) if r["round"] == "6"]
            found[f"{policy}_{target}"] = median(rows, "log_prob_true")
    return found


def alarms() -> dict[str, int]:
    """Return false alarms in clean sets of the worlds A, B and C."""
    folder = HERE / "criticism/results"
    rows = [r for world in "ABC" for r in read(folder / f"{world}_clean.csv")]
    return {"false": sum(r["verdict"] != "none" for r in rows), "sets": len(rows)}


def causes() -> dict[str, int]:
    """Return sets of A, B and C with an effect that matters, detected, put first."""
    from benchmarks.criticism.tables import ranks, strong
    from benchmarks.criticism.worlds import get_world

    found = {"detected": 0, "first": 0, "sets": 0}
    for name in "ABC":
        world = get_world(name)
        rows = strong(world, read(HERE / f"criticism/results/{name}_library.csv"))
        places = ranks(world, rows)
        found["sets"] += len(rows)
        found["detected"] += len(places)
        found["first"] += sum(place == 1 for place in places)
    return found


def robots() -> dict[str, int]:
    """Return effects hidden in robots that a verdict names or states, and alarms."""
    rows = read(HERE / "robots/results/hidden.csv")
    hidden = [r for r in rows if r["kind"] == "hidden" and int(r["seed"]) >= 2000]
    clean = [r for r in rows if r["kind"] == "clean" and int(r["seed"]) >= 2000]
    return {
        "right": sum(r["right"] == "1" for r in hidden),
        "sets": len(hidden),
        "false": sum(r["alarm"] == "1" for r in clean),
        "clean": len(clean),
    }


def apart() -> dict[str, float]:
    """Return the chosen trials that put the truth first as often as all random ones."""
    from benchmarks.criticism.active import Curves

    curves = Curves.of(read(HERE / "criticism/results/A_active.csv"))
    random = curves.trials[-1]
    return {"random": random, "chosen": curves.matched("top-1", random)}


def servo() -> dict[str, float]:
    """Return the servo's error before and after, and beside least squares'."""
    row = load("measured/results/servo_pendulum.json")["motor off"]
    before, after = (row["before_after"][key][0] for key in ("before", "after"))
    fitted = row["least squares"][row["model"]]["held_out"]
    return {"before": before, "after": after, "ratio": after / fitted}


def leg() -> dict[str, float]:
    """Return the error of a quadruped's knee before and after, mrad."""
    row = load("measured/results/go2.json")["FL"]
    return {key: 1e3 * row[key]["held out"][-1] for key in ("before", "after")}


def attacks() -> dict[str, int]:
    """Return how many attacks were survived, of all."""
    from benchmarks.robustness.run import AREAS, rows_of

    rows = [r for area in AREAS for r in rows_of(area)]
    return {"survived": sum(r["survived"] == "True" for r in rows), "all": len(rows)}


FIGURES: dict[str, Callable[[], Mapping[str, float]]] = {
    f.__name__: f
    for f in (numerical, round_time, training, box, alarms, causes, robots, apart)
    + (servo, leg, attacks)
}


def median(rows: list[dict[str, str]], key: str) -> float:
    """Return the median of a column."""
    return float(np.median([float(r[key]) for r in rows]))


def load(path: str) -> Any:
    """Return a JSON file below ``benchmarks/``."""
    return json.loads((HERE / path).read_text())


def table(stated: Path = STATED) -> tuple[list[str], list[str]]:
    """Return the table's lines, and a line for each figure that misses its value.

    Args:
        stated: File of the rows and their stated values.
    """
    lines, misses = [*HEADER], []
    for row in toml(stated)["row"]:
        found = FIGURES[row["figures"]]()
        cells = (without_zero(row[k].format(**found)) for k in ("result", "beside"))
        lines.append(f"| {row['what']} | {' | '.join(cells)} |".replace("|  |", "| |"))
        for sign, way in ((1, "least"), (-1, "most")):
            misses += [
                f"{row['figures']}: expected {key} at {way} {value}; got {found[key]:g}"
                for key, value in row.get(way, {}).items()
                if not sign * found[key] >= sign * value
            ]
    return lines, misses


def without_zero(text: str) -> str:
    """Return numbers below one without the zero before the point, as in .05."""
    return re.sub(r"\b0\.", ".", text)


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


def shown(path: Path, *only: str) -> str:
    """Return the numbers of a file below patterns of paths as a Markdown table."""
    cells = [
        [name, value]
        for name, value in leaves(json.loads(path.read_text()))
        if any(fnmatch(name, pattern) for pattern in only or ("*",))
    ]
    return Table(["what", "value"], cells).markdown()


def main(file: str, *, only: Sequence[str] = ("*",)) -> int:
    """Print the table.

    Args:
        file: Path of the file below benchmarks/; ``readme`` is README's own table.
        only: Patterns of paths; all by default.
    """
    if file == "readme":
        lines, misses = table()
        print(*lines, sep="\n")
        print(*misses, sep="\n", file=sys.stderr)
        return 1 if misses else 0
    if (path := HERE / file).suffix == ".csv":
        rows = read(path)
        print(Table([*rows[0]], [[*row.values()] for row in rows]).markdown())
    else:
        print(shown(path, *only))
    return 0

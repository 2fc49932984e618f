"""Rows of results in files, and the one loop of benchmarks that add to them.

What papers report, from ``published.csv``: table, row, values and source.
"""

from __future__ import annotations

import csv
import inspect
import io
import json
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import date
from itertools import product
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
import pandas as pd
from torch import Tensor

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

T = TypeVar("T")
Row = Mapping[str, Any]
LONGEST = 300  # characters of an error that are kept


def read(path: Path) -> list[dict[str, Any]]:
    """Return the rows of a file of CSV or of JSON lines, none if it is not there."""
    if not path.exists():
        return []
    with path.open(newline="") as file:
        if path.suffix == ".jsonl":
            return [json.loads(line) for line in file]
        return [*csv.DictReader(file)]


def append(path: Path, rows: Sequence[Row]) -> None:
    """Add rows to a file, six digits a number in CSV; new columns come last."""
    path.parent.mkdir(parents=True, exist_ok=True)
    known = read(path)
    if path.suffix == ".jsonl":
        with path.open("a") as file:
            file.writelines(json.dumps(row) + "\n" for row in rows)
        return
    columns = dict.fromkeys(key for row in (*known[:1], *rows) for key in row)
    if known and len(columns) == len(known[0]):
        with path.open("a", newline="") as file:
            writer = csv.DictWriter(file, columns, lineterminator="\n")
            writer.writerows({k: short(v) for k, v in row.items()} for row in rows)
    else:
        write(path, [*known, *rows])


def write(path: Path, rows: Sequence[Row]) -> None:
    """Write a CSV file of these rows, whole: a kill costs nothing that was there."""
    part = path.with_suffix(".part")
    with part.open("w", newline="") as file:
        columns = dict.fromkeys(key for row in rows for key in row)
        writer = csv.DictWriter(file, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows({k: short(v) for k, v in row.items()} for row in rows)
    part.replace(path)


def resumed(
    path: Path,
    keys: Sequence[str],
    jobs: Iterable[Sequence[Any]],
    make: Callable[..., Row | Sequence[Row]],
    *,
    may_fail: bool = False,
) -> list[dict[str, Any]]:
    """Add the rows of jobs that a file does not have yet, and return all its rows.

    Args:
        path: Path of the file.
        keys: Columns that tell jobs apart.
        jobs: Values of these columns, which are the arguments of ``make``.
        make: Function that returns the row, or the rows, of a job; the columns that
            tell jobs apart are added.
        may_fail: Whether a crash is a result too, in the column "failure".
    """
    done = {tuple(str(row[key]) for key in keys) for row in read(path)}
    for job in jobs:
        if tuple(map(str, job)) in done:
            continue
        start = time.process_time()
        try:
            made = make(*job)
        except Exception as error:
            if not may_fail:
                raise
            made = {"failure": f"{type(error).__name__}: {error}"[:LONGEST]}
        each = [made] if isinstance(made, Mapping) else made
        rows = [dict(zip(keys, job, strict=True)) | {**row} for row in each]
        if not rows:
            continue
        append(path, rows)
        said = rows[-1].get("failure") or rows[-1].get("verdict") or ""
        spent = f"{time.process_time() - start:.0f} CPU s"
        print(path.stem, *job, said, spent, flush=True)
    return read(path)


def benchmark(
    path: Path,
    make: Callable[..., Row | Sequence[Row]],
    table: Callable[[list[dict[str, Any]]], str],
    *,
    skip: Callable[..., bool] = lambda *job: False,
    may_fail: bool = False,
    given: Mapping[str, str] | None = None,
    default: Mapping[str, Sequence[Any]] | None = None,
    **axes: Iterable[Any],
) -> Callable[..., None]:
    """Return the main of a benchmark: every case a row of a file, and their table.

    Args:
        path: File of the rows. Axes in braces, as in ``{method}.csv``, name a file
            each, and are no columns of it.
        make: Function of a case that returns its row or rows.
        table: Function that returns the table of the rows that are asked for, those
            axes of files among their keys.
        skip: Function that says which cases are not run.
        may_fail: Whether a crash is a result too.
        given: Further paths that ``make`` takes by keyword, each with what it is.
        default: Values of an axis that are run where none are asked for; all others.
        axes: Values of what makes a case; ranges vary slowest. Each is an option, a
            range by its ends and in the plural: ``--seeds 0 10``.
    """
    taken = [*inspect.signature(make).parameters]  # by place; names may be others
    assert all(k not in taken or taken[i] == k for i, k in enumerate(axes)), taken
    ranges = {key: axis for key, axis in axes.items() if isinstance(axis, range)}
    option = {key: key + "s" * (key in ranges) for key in axes}
    slowest = sorted(axes, key=lambda k: k not in ranges)

    def main(*, summary: bool = False, out: Path = path, **asked: Any) -> None:
        chosen = {
            k: range(*asked[name]) if k in ranges else asked[name]
            for k, name in option.items()
        }
        further = {name: asked[name] for name in given or {}}
        of_file = [k for k in axes if f"{{{k}}}" in out.name]
        columns = [k for k in axes if k not in of_file]
        found: list[dict[str, Any]] = []
        for values in product(*(chosen[k] for k in of_file)):
            fixed = dict(zip(of_file, values, strict=True))

            def whole(*job: Any, fixed: dict[str, Any] = fixed) -> list[Any]:
                case = fixed | dict(zip(columns, job, strict=True))
                return [case[k] for k in axes]

            order = [k for k in slowest if k in columns]
            cases = product(*(chosen[k] for k in order))
            named = (dict(zip(order, case, strict=True)) for case in cases)
            jobs = ([by[k] for k in columns] for by in named)
            rows = resumed(
                out.with_name(out.name.format(**fixed)),
                columns,
                () if summary else (job for job in jobs if not skip(*whole(*job))),
                lambda *job, whole=whole: make(*whole(*job), **further),
                may_fail=may_fail,
            )
            found += [fixed | row for row in rows]
        print(
            table([r for r in found if all(_is_asked(r[k], chosen[k]) for k in axes)])
        )

    hints: dict[str, Any] = {"summary": bool, "out": Path}
    defaults: dict[str, Any] = {"summary": False, "out": path}
    lines = ["summary: Whether to run nothing, and print the table of the rows."]
    lines += ["out: File of the rows."]
    for key, axis in axes.items():
        values = (axis.start, axis.stop) if isinstance(axis, range) else (*axis,)
        kind = tuple[int, int] if key in ranges else Sequence[type(values[0])]
        is_named = key not in ranges and isinstance(values[0], str)
        hints[option[key]] = Annotated[kind, values] if is_named else kind
        defaults[option[key]] = (default or {}).get(key, values)
        what = "First, and one past the last" if key in ranges else "Those that are run"
        lines.append(f"{option[key]}: {what}, of each {key}.")
    for name, what in (given or {}).items():
        hints[name], defaults[name] = Path, None
        lines.append(f"{name}: {what}")
    main.__doc__ = "Run the cases that are missing, and print the table.\n\nArgs:\n"
    main.__doc__ += "\n".join(f"    {line}" for line in lines)
    main.__annotations__ = hints
    parameters = [
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=value)
        for name, value in defaults.items()
    ]
    main.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    return main


def _is_asked(value: Any, among: Any) -> bool:
    """Return whether a row's value is among an option's."""
    return str(value) in map(str, among)


def frame(rows: Sequence[Row]) -> pd.DataFrame:
    """Return rows of text as a data frame of numbers, flags and texts."""
    return pd.read_csv(io.StringIO(pd.DataFrame(rows).to_csv(index=False)))


def column(rows: Sequence[Row], key: str, round_: int | None = None) -> np.ndarray:
    """Return a column of one round, or of all, as numbers; NaN where it is empty."""
    kept = [r.get(key) for r in rows if round_ is None or int(r["round"]) == round_]
    return np.array([float(v) if v else np.nan for v in kept])


def grouped(rows: Iterable[Row], *keys: str) -> dict[tuple[Any, ...], list[Any]]:
    """Return rows by the values of some columns, in the order of the first of each."""
    groups: dict[tuple[Any, ...], list[Any]] = {}
    for row in rows:
        groups.setdefault(tuple(row[key] for key in keys), []).append(row)
    return groups


def short(value: Any) -> Any:
    """Return a number with six digits."""
    return f"{float(value):.6g}" if isinstance(value, (float, Tensor)) else value


def toml(path: Path) -> dict[str, Any]:
    """Return the tables of a TOML file."""
    return tomllib.loads(path.read_text(encoding="utf-8"))


def stages(path: Path) -> dict[str, Any]:
    """Return the stages of a JSON file by name, none if it is not there."""
    return json.loads(path.read_text()) if path.is_file() else {}


def keep(path: Path, rows: Mapping[str, Any]) -> None:
    """Write all stages of a JSON file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(rows, indent=1) + "\n")


def recorded(path: Path, command: str, **figures: Any) -> None:
    """Write figures to a JSON file, with the command that made them and the date."""
    made = {"command": f"python -m benchmarks {command}", "date": str(date.today())}
    keep(path, made | figures)


def add(path: Path, rows: dict[str, Any], name: str, row: Mapping[str, Any]) -> None:
    """Add a stage to those of a JSON file, write all, and say what it is."""
    rows[name] = row
    keep(path, rows)
    print(f"{name}: {row.get('line') or row.get('verdict', '')}", flush=True)


def measured(read_data: Callable[..., T], *arguments: Any) -> T:
    """Return measured data, or end the process where they are not there."""
    try:
        return read_data(*arguments)
    except FileNotFoundError as error:
        raise SystemExit(f"{error}, as in --data DIR") from None


FILE = Path(__file__).with_name("published.csv")


def published(table: str) -> dict[str, tuple[str, ...]]:
    """Return the rows of a table, by name, each with its values in the file's order."""
    with FILE.open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["table"] == table]
    return {
        row["row"]: tuple(value.strip() for value in row["values"].split(";"))
        for row in rows
    }

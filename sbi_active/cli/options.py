"""Values from words: numbers, options of several words, files of options."""

from __future__ import annotations

import csv
import difflib
import io
import math
import re
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import click

#: Options that no file and no request sets: where these are, and who is trusted.
UNWRITTEN = ("config", "trust", "json")
PROBLEM = "problem.toml"  # options of a folder of recordings
#: What float32 holds with all its digits, beside 0.
SMALLEST, LARGEST = 2.0**-126, 2.0**128 - 2.0**104

COUNT = click.IntRange(min=1)
FILE, FOLDER = click.Path(path_type=Path), click.Path(path_type=Path, file_okay=False)


def text(word: str) -> str:
    """Return a word as text, in UTF-8 whatever the locale."""
    return word.encode(errors="surrogateescape").decode()


class Several(click.Option):
    """An option that takes all words up to the next option."""


class Command(click.Command):
    """A command that takes :class:`Several`, and for a value what is like ``-1e-3``."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Set the parameters of the context by words."""
        if ctx.resilient_parsing:
            return super().parse_args(ctx, args)
        known = {name: param for param in self.get_params(ctx) for name in param.opts}
        words, several, awaits = [], "", ""
        for k, word in enumerate(args):
            name, equals, _ = word.partition("=")
            if word == "--":
                words += args[k:]
                break
            if re.match(r"-[^\d.]", word):
                if name not in known:
                    near = difflib.get_close_matches(name, known)
                    raise click.NoSuchOption(name, possibilities=near, ctx=ctx)
                if awaits:
                    said = f"Option {awaits!r} requires an argument."
                    raise click.BadOptionUsage(awaits, said, ctx)
                several = name if isinstance(known[name], Several) else ""
                if several:  # of two alike the last counts
                    words = [w for w in words if not w.startswith(f"{name}=")]
                if several and not equals:
                    continue
                is_flag = getattr(known[name], "is_flag", False)
                awaits = "" if equals or is_flag else name
            elif awaits:
                awaits = ""
            elif several:
                word = f"{several}={word}"
            words.append(word)
        return super().parse_args(ctx, words)


def take_config(
    ctx: click.Context, _: click.Parameter, path: Path | None
) -> Path | None:
    """Take from a TOML file what the command line leaves out."""
    if path is None or ctx.resilient_parsing:
        return path
    if sys.version_info >= (3, 11):
        import tomllib
    else:
        import tomli as tomllib

    try:
        values = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except ValueError as error:
        raise ValueError(
            f"expected TOML in {path}; got {error}; write options as in "
            'theta-low = "0,1"'
        ) from error
    options = [p for p in ctx.command.params if isinstance(p, click.Option)]
    found = as_written(options, values, str(path))
    ctx.default_map = {k: _beside(path.parent, v) for k, v in found.items()}
    return path


def _beside(folder: Path, value: Any) -> Any:
    """Return what a file says, with the path of programs that lie beside it."""
    if isinstance(value, list):
        return [_beside(folder, part) for part in value]
    file, colon, name = str(value).partition(":")
    is_there = file.endswith(".py") and (folder / file).is_file()
    return f"{folder / file}{colon}{name}" if is_there else value


def take_problem(ctx: click.Context, param: click.Parameter, folder: Path) -> Path:
    """Take from a folder's problem.toml what no other file and no option gives."""
    path = folder / PROBLEM
    if ctx.default_map is None and path.is_file():
        take_config(ctx, param, path)
    return folder


def as_written(
    params: Sequence[click.Parameter], values: Mapping[str, Any], place: str
) -> dict[str, Any]:
    """Return plain data as the command line writes it, by the names of parameters.

    Args:
        params: Parameters that may be set.
        values: Values from TOML or JSON; names with dashes or without.
        place: Place where they stand, for the error.

    Raises:
        ValueError: If a name is none of a parameter.
    """
    known = {str(p.name): p for p in params if p.name not in UNWRITTEN}
    named = {name.replace("-", "_"): value for name, value in values.items()}
    for name in {*named} - {*known}:
        raise ValueError(
            f"expected options among {', '.join(sorted(known)) or 'none'}; got "
            f"{name!r} in {place}; remove it or write one of these"
        )
    return {k: _written(known[k], v) for k, v in named.items() if v is not None}


def _written(param: click.Parameter, value: Any) -> Any:
    if isinstance(value, dict):  # as in columns = {trial = "ball", x = "height"}
        value = [f"{k}={_joined(v)}" for k, v in value.items()]
    if param.nargs == -1:  # numbers of any shape, null for one not measured
        return ["nan" if v is None else str(v) for v in flat(value)]
    if getattr(param, "is_flag", False):
        return value
    if param.multiple:
        return [str(v) for v in (value if isinstance(value, list) else [value])]
    return _joined(value)


def _joined(value: Any) -> str:
    return ",".join(map(str, value)) if isinstance(value, list) else str(value)


def flat(value: Any) -> list[Any]:
    """Return the parts of nested lists."""
    if not isinstance(value, list):
        return [value]
    return [part for item in value for part in flat(item)]


def numbers_of(text: str) -> list[float]:
    """Return finite numbers that are separated by commas."""
    return [number_of(part) for part in text.split(",")]


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

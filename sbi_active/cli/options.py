"""How words become values: numbers, types, options of several, files of options."""

from __future__ import annotations

import csv
import difflib
import io
import math
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import click
from click.shell_completion import CompletionItem

#: Options that no file and no request sets: where these are, and who is trusted.
UNWRITTEN = ("config", "trust", "json")
PROBLEM = "problem.toml"  # options of a folder of recordings
#: What float32 holds with all its digits, beside 0.
SMALLEST, LARGEST = 2.0**-126, 2.0**128 - 2.0**104


class Value(click.ParamType):
    """A word that a function reads, with an error that says what was expected.

    Args:
        what: Words for the error.
        read: Returns the value of a word; ValueError or KeyError for any other word.
        names: Of the words, for the completion of a shell.
        kind: Of the words, for the help; a shell completes a "file" or a "dir".
    """

    def __init__(
        self,
        what: str,
        read: Callable[[Any], Any],
        names: Sequence[str] = (),
        kind: str = "text",
    ) -> None:
        self.name, self._names, self._kind = "value", names, kind
        self._what, self._read = what, read

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> Any:
        """Return the value of a word."""
        try:
            return self._read(value)
        except (ValueError, KeyError):
            hint = "choose one of these" if self._names else "correct it"
            self.fail(f"expected {self._what}; got {value!a:.80}; {hint}", param, ctx)

    def get_metavar(self, param: click.Parameter, ctx: click.Context) -> str:
        """Return what stands for a word in the help."""
        return "|".join(self._names) or self._kind.upper()

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        """Return how a word that has begun may go on."""
        if self._kind in ("file", "dir"):
            return [CompletionItem(incomplete, type=self._kind)]
        return [CompletionItem(n) for n in self._names if n.startswith(incomplete)]


def one_of(names: Sequence[str]) -> Value:
    """Return the type of one of some names."""
    return Value(f"one of {', '.join(names)}", {n: n for n in names}.__getitem__, names)


def _count(word: Any) -> int:
    if int(word) < 1:
        raise ValueError(f"expected at least 1; got {word}; write more")
    return int(word)


def _text(word: str) -> str:
    """Return a word as text, in UTF-8 whatever the locale."""
    return word.encode(errors="surrogateescape").decode()


PORT = Value("a port, 0 to 65535", lambda w: range(65_536).index(int(w)), kind="n")
WHOLE = Value("a whole number", int, kind="n")
COUNT = Value("a whole number >= 1", _count, kind="n")
SECONDS, TEXT = Value("a number", float, kind="s"), Value("text in UTF-8", _text)
FILE, FOLDER = Value("a path", Path, kind="file"), Value("a path", Path, kind="dir")


class Several(click.Option):
    """An option that takes all words up to the next option."""

    def __init__(self, names: Sequence[str], **settings: Any) -> None:
        super().__init__(names, multiple=True, **settings)


class Group(click.Group):
    """Commands, with an error that says which there are."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Return what the command gets."""
        word = args[0] if args else "none"
        is_option = word.startswith("-")
        if word in self.commands or is_option or ctx.resilient_parsing:
            return super().parse_args(ctx, args)
        near = difflib.get_close_matches(word, self.commands, 1)
        todo = f"write {near[0]}" if near else "choose one of these"
        names = ", ".join(sorted(self.commands))
        text = f"expected a command among {names}; got {word}; {todo}"
        raise click.UsageError(text, ctx)


class Command(click.Command):
    """A command that takes :class:`Several`, and for a value what is like ``-1e-3``."""

    def __init__(self, name: str, **settings: Any) -> None:
        names = {"help_option_names": ["-h", "--help"], "ignore_unknown_options": True}
        super().__init__(name, context_settings=names, **settings)

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Set the parameters of the context by words."""
        if ctx.resilient_parsing:
            return super().parse_args(ctx, args)
        options = [p for p in self.get_params(ctx) if isinstance(p, click.Option)]
        known = {name: option for option in options for name in option.opts}
        words: list[str] = []
        lists: dict[str, list[str]] = {}  # of several; of two alike the last counts
        several, awaits = "", ""
        for k, word in enumerate(args):
            name, equals, value = word.partition("=")
            is_option = re.match(r"-[^\d.]", word) is not None
            if is_option and awaits and name in known:
                raise click.UsageError(f"expected a value of {awaits}; got {word}", ctx)
            if word == "--" and not awaits:
                words += args[k:]
                break
            if awaits or not is_option:
                (lists[several] if several else words).append(word)
                awaits = ""
            elif name not in known:
                near = difflib.get_close_matches(name, known)
                raise click.NoSuchOption(name, possibilities=near, ctx=ctx)
            elif isinstance(known[name], Several):
                lists[name] = [value] if equals else []
                several, awaits = ("", "") if equals else (name, name)
            else:
                words.append(word)
                several, awaits = "", "" if known[name].is_flag or equals else name
        told = [f"{name}={value}" for name, values in lists.items() for value in values]
        return super().parse_args(
            ctx, [*told, *words, *filter(None, [several and awaits])]
        )

    def invoke(self, ctx: click.Context) -> Any:
        """Return what the command's function returns."""
        ctx.obj.update(ctx.params)  # for errors, in which the folder is named
        return super().invoke(ctx)


def in_words(error: click.ClickException) -> str:
    """Return an error of click in the words of this library's."""
    text, ctx = error.format_message(), getattr(error, "ctx", None)
    path = "sbi-active" if ctx is None else ctx.command_path
    if isinstance(error, click.NoSuchOption):
        near = " or ".join(error.possibilities or ())
        todo = f"write {near}" if near else "leave it out"
        got = f"got {error.option_name}; {todo}, or see {path} --help"
        return f"expected an option of {path}; {got}"
    if isinstance(error, click.MissingParameter) and error.param is not None:
        what = error.param.get_error_hint(ctx) if ctx else error.param.name
        return f"expected {what}; got none; give it, or see {path} --help"
    if isinstance(error, click.BadParameter) and error.param is not None:
        return f"{error.param.get_error_hint(ctx) if ctx else ''}: {error.message}"
    return f"{text.rstrip('.')}, or see {path} --help"


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
    ctx.default_map = as_written(options, values, str(path))
    return path


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
        params: That may be set.
        values: From TOML or JSON; names with dashes or without.
        place: Where they stand, for the error.

    Raises:
        ValueError: If a name is none of a parameter.
    """
    known = {p.name: p for p in params if p.name and p.name not in UNWRITTEN}
    found = {}
    for name, value in values.items():
        param = known.get(name.replace("-", "_"))
        if param is None or param.name is None:
            names = ", ".join(sorted(known)) or "none"
            raise ValueError(
                f"expected options among {names}; got {name!r} in {place}; remove it "
                "or write one of these"
            )
        if value is not None:
            found[param.name] = _written(param, value)
    return found


def _written(param: click.Parameter, value: Any) -> Any:
    if getattr(param, "is_flag", False):
        if not isinstance(value, bool):
            raise ValueError(
                f"expected true or false as {param.name}; got {value!r:.80}; correct it"
            )
        return value
    if isinstance(value, dict):  # as in columns = {trial = "ball", x = "height"}
        value = [f"{k}={_joined(v)}" for k, v in value.items()]
    if param.nargs == -1:  # numbers of any shape, null for one not measured
        return ["nan" if v is None else str(v) for v in flat(value)]
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
        place: Where it stands, for the error.
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
        text = path.read_text(encoding="utf-8-sig")
        rows = [*csv.reader(io.StringIO(text, newline=""), strict=True)]
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(
            f"expected a table of numbers, as text in UTF-8; got {path} ({error}); "
            "save it so"
        ) from error
    # A heading has no cell that begins like a number: 0.84 m and 0,84;1 are none.
    begins = re.compile(r"\s*(?:[-+]?\.?\d|[-+]?(?:nan|inf)\b|$)", re.IGNORECASE)
    is_headed = bool(rows) and not any(map(begins.match, rows[0]))
    return [
        number_of(
            cell.strip() or "nan", f" in row {i}, column {k} of {path}", is_outcome=True
        )
        for i, row in enumerate(rows, start=1)
        if i > 1 or not is_headed
        for k, cell in enumerate(row, start=1)
    ]

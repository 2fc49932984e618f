"""The program ``sbi-active``: its commands, options and their types, and answers."""

from __future__ import annotations

import contextlib
import ctypes
import json
import math
import os
import re
import sys
import traceback
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import click

from sbi_active.expected import require
from sbi_active.plain import plain

NAME = "sbi-active"
FAILED, MISUSED, INTERRUPTED = 1, 2, 130
#: What a call raises that is none: of other names, types, files, or nested too deeply.
MISUSES = TypeError, AttributeError, ImportError, FileNotFoundError, RecursionError
MISUSES += json.JSONDecodeError, UnicodeDecodeError
#: Frames in what a worker says of an error, which is told without them.
FRAMES = re.compile(r"Traceback \(most recent call last\):\n(?: .*\n)*")
#: Names of the methods, as in ``sbi_active.campaign.learning.methods.METHODS``.
METHODS = ("asbi", "nsbi", "alhi", "nlhi", "seqbed")


class Answer(NamedTuple):
    """The answer of a command.

    Attributes:
        data: Data for programs; numbers that are not finite become null.
        text: Text for people.
        status: Exit status.
    """

    data: dict[str, Any]
    text: str
    status: int = 0


class Numbers(click.ParamType):
    """Finite numbers with commas between them; in a request also a list."""

    name = "numbers"

    def convert(self, value: Any, param: Any, ctx: Any) -> list[float]:
        """Return the numbers of a value."""
        parts = value if isinstance(value, list) else str(value).split(",")
        return [number_of(str(part)) for part in parts]


program = click.Group(
    NAME,
    help="Tune a black-box simulator from a handful of real trials.",
    epilog="Exit status: 0; 1 where something failed, as in the simulator; 2 where the "
    "call or a file has to be changed; 10 to 14 where a gate is closed; 130 after an "
    "interrupt.",
    context_settings={"help_option_names": ["-h", "--help"]},
)
click.version_option(package_name=NAME, message="%(version)s")(program)


def command(*params: click.Parameter, **settings: Any) -> Any:
    """Return a decorator that makes a function a command, its docstring the help.

    Args:
        *params: Arguments and options of the command, in the order of the help.
        **settings: Settings of its context.
    """
    return program.command(params=[*params], context_settings=settings)


def option(
    name: str, help: str, type: Any = str, metavar: str | None = None, **settings: Any
) -> click.Option:
    """Return an option.

    Args:
        name: Name with its dashes.
        help: Text that says what it does.
        type: Type of its value; None for a flag.
        metavar: Value as the help shows it.
        **settings: Further settings of :class:`click.Option`.
    """
    settings["show_default"] = settings.get("default") not in (None, "")
    what: Any = {"is_flag": True} if type is None else {"type": type}
    return click.Option([name], help=help, metavar=metavar, **what, **settings)


def repeated(name: str, help: str, metavar: str) -> click.Option:
    """Return an option that may be given several times."""
    return option(name, f"{help}; again for each", str, metavar, multiple=True)


def argument(name: str, metavar: str, type: Any, **more: Any) -> click.Argument:
    """Return an argument."""
    return click.Argument([name], metavar=metavar, type=type, **more)


NUMBERS, COUNT = Numbers(), click.IntRange(min=1)
FILE, FOLDER = click.Path(path_type=Path), click.Path(path_type=Path, file_okay=False)
DIR = argument("folder", "DIR", FOLDER)
TASK = option("--task", "in place of a simulator", metavar="TASK")
OF_TASK = repeated("--option", "of the task, as variant=sinh", "NAME=VALUE")
METHOD = option("--method", "by which it learns", click.Choice(METHODS), default="asbi")
SEED = option("--seed", "of all that is random", int, default=0)
SETTINGS = repeated("--set", "as num_simulations=2000 or stop.max_sd=0.1", "NAME=VALUE")
JSON = option("--json", "for programs, errors too", None, expose_value=False)
PLACE = "module or file.py, which may have a prior, actions and effects as well"
SIMULATOR = option("--simulator", PLACE, metavar="MODULE:FUNCTION")
NOISE = option("--noise", "standard deviation of x", NUMBERS, "SD[,SD...]")
SPACE = [
    NOISE,
    option("--theta-low", "one a parameter", NUMBERS, "A,B,..."),
    option("--theta-high", "one a parameter", NUMBERS, "A,B,..."),
    repeated("--actions", "an entry, LOW:HIGH, LOW:HIGH:COUNT or A,B,...", "SPEC"),
]


def say(said: object) -> None:
    """Print a note or an error to standard error."""
    click.echo(f"sbi-active: {said}", err=True)


def failure(error: BaseException) -> dict[str, Any]:
    """Return an error for programs: its class, its text, and the exit status."""
    status, text = FAILED, located(error)
    if isinstance(error, KeyboardInterrupt):
        said = str(error) or "interrupted"
        status, text = INTERRUPTED, f"{said}; what was told before is kept"
    elif isinstance(error, click.ClickException):
        status, text = MISUSED, error.format_message()
    elif isinstance(error, ValueError | OSError) and type(error) is not BrokenPipeError:
        status, text = MISUSED, str(error)
    said = FRAMES.sub("", text)
    return {"type": type(error).__name__, "message": said, "status": status}


def located(error: BaseException) -> str:
    """Return the class and the text of an error, and where it was raised."""
    text, frames = f"{type(error).__name__}: {error}", error.__traceback__
    if isinstance(error, SyntaxError) or frames is None:  # whose text has it
        return text
    last = traceback.extract_tb(frames)[-1]
    return f"{text} ({last.filename}, line {last.lineno})"


@contextlib.contextmanager
def misuse(what: str) -> Iterator[None]:
    """Have errors of a call count as one of the command line."""
    try:
        yield
    except MISUSES as error:
        said = f"expected {what}; got {error}; correct it"
        is_whole = str(error).startswith("expected ")
        raise ValueError(error if is_whole else said) from error


def as_line(value: Any) -> str:
    """Return an answer as one line of JSON, null for a number that is not finite."""
    return json.dumps(plain(value), allow_nan=False)


@contextlib.contextmanager
def output_to_errors() -> Iterator[None]:
    """Send to standard error what simulators print, in C and in workers too."""
    kept = os.dup(1)
    os.dup2(2, 1)
    try:
        with contextlib.redirect_stdout(sys.stderr):
            yield
    finally:
        with contextlib.suppress(Exception):  # a platform without it
            ctypes.CDLL(None).fflush(None)
        os.dup2(kept, 1)
        os.close(kept)


def pairs_of(texts: Sequence[str]) -> dict[str, Any]:
    """Return the parts of texts NAME=VALUE, values as JSON where they are.

    Raises:
        ValueError: If one is no such text.
    """
    pairs = {name: value for name, _, value in (t.partition("=") for t in texts)}
    for name, value in pairs.items():
        require(bool(name and value), "NAME=VALUE", repr(name), "write, say, target=2")
        with contextlib.suppress(ValueError, RecursionError):
            pairs[name] = json.loads(value)
    return pairs


def number_of(text: str, *, is_outcome: bool = False) -> float:
    """Return a number as written, which float32 has to hold.

    Args:
        text: The number; nan in an outcome.
        is_outcome: Whether it may be one that was not measured.

    Raises:
        ValueError: If it is anything else.
    """
    value = math.inf
    with contextlib.suppress(ValueError):
        value = float(text.replace("_", "?"))
    is_held = value == 0 or 2.0**-126 <= abs(value) <= 2.0**128 - 2.0**104
    advice = "write them apart by blanks, with a point as in 1.5 or 2e-3, no unit"
    is_right = is_held or is_outcome and math.isnan(value)
    require(is_right, "finite numbers of float32", f"{text!r:.80}", advice)
    return value

"""The program ``sbi-active``: how commands are declared, and the types of options.

The values of options stand in words, in a file of TOML, or in a request of JSON;
numbers also in tables.
"""

from __future__ import annotations

import csv
import io
import json
import math
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import click

NAME = "sbi-active"
#: Names of the tasks, as in ``sbi_active.tasks.TASKS``.
TASKS = (
    *("numerical", "oscillator", "box_collision", "pouring", "pouring_real"),
    *("servo_pendulum", "ball_drops", "location_finding", "chain"),
)
#: Names of the methods, as in ``sbi_active.campaign.learning.methods.METHODS``.
METHODS = ("asbi", "nsbi", "alhi", "nlhi", "seqbed")
#: Options of the last version, now settings.
FORMER = {
    "num-simulations": "num_simulations",
    "simulations": "num_simulations",
    "num-samples": "num_samples",
    "num-workers": "workers.num_workers",
    "time-limit": "workers.time_limit",
}
#: What float32 holds with all its digits, beside 0.
SMALLEST, LARGEST = 2.0**-126, 2.0**128 - 2.0**104
#: Options that no file and no request sets: where these are, and who is trusted.
UNWRITTEN = ("config", "trust", "json")
OF_FOLDER = "problem.toml"  # options of a folder of recordings
BOUNDARY = "\0"  # between the words of an option of several; no word has it


class Text(click.ParamType):
    """A word in UTF-8, whatever the locale; in a file or a request also a list."""

    name = "text"

    def convert(self, value: Any, param: Any, ctx: Any) -> str:
        """Return the text of a value."""
        text = ",".join(map(str, value)) if isinstance(value, list) else str(value)
        if text.startswith("--"):  # the next option
            said = f"Option {param.opts[0]!r} requires an argument."
            raise click.BadOptionUsage(param.opts[0], said, ctx)
        return text.encode(errors="surrogateescape").decode()


class Numbers(Text):
    """Finite numbers with commas between them, or a list of these."""

    def convert(self, value: Any, param: Any, ctx: Any) -> Any:
        """Return the numbers of a value."""
        text = super().convert(value, param, ctx)
        return [number_of(part) for part in text.split(",")]


class Several(click.ParamType):
    """All words up to the next option; in a file a list, or a table of NAME=VALUE."""

    name = "words"

    def convert(self, value: Any, param: Any, ctx: Any) -> list[str]:
        """Return the words of a value."""
        if isinstance(value, dict):  # as in columns = {trial = "ball", x = "height"}
            value = [f"{k}={TEXT.convert(v, param, ctx)}" for k, v in value.items()]
        several = value.split(BOUNDARY) if isinstance(value, str) else value
        several = several if isinstance(several, list) else [several]
        return [TEXT.convert(word, param, ctx) for word in several]


class Measured(click.ParamType):
    """A number that was measured, or nan."""

    name = "x"

    def convert(self, value: Any, param: Any, ctx: Any) -> float:
        """Return the number, which a slip of the pen is not."""
        if re.match(r"-[^\d.]", str(value)):
            raise click.NoSuchOption(value, ctx=ctx)
        return number_of(str(value), is_outcome=True)


TEXT, NUMBERS, MEASURED = Text(), Numbers(), Measured()
SEVERAL, PAIRS = Several(), Several()  # given again, the last counts, or all do
COUNT = click.IntRange(min=1)
FILE, FOLDER = click.Path(path_type=Path), click.Path(path_type=Path, file_okay=False)


class Command(click.Command):
    """A command whose options of the type :class:`Several` take several words."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Set the parameters of the context by words."""
        several = {name: param.type for param in self.params for name in param.opts}
        several = {n: kind for n, kind in several.items() if isinstance(kind, Several)}
        taken: dict[str, list[str]] = {}
        words, name, left = [], "", iter([] if ctx.resilient_parsing else args)
        for word in left:
            if re.match(r"-[^\d.]", word):
                name, equals, value = word.partition("=")
                setting = FORMER.get(name[2:]) if "--set" in several else None
                if setting is not None:
                    value = value if equals else next(left, "")
                    taken.setdefault("--set", []).append(f"{setting}={value}")
                elif name in several:
                    before = taken.get(name, []) if several[name] is PAIRS else []
                    taken[name] = [*before, *([value] if equals else [])]
                    continue
                else:
                    words.append(word)
                name = ""
            elif name:
                taken[name].append(word)
            else:
                words.append(word)
        joined = [f"{name}={BOUNDARY.join(taken[name])}" for name in taken]
        return super().parse_args(ctx, [*joined, *words] or args)


program = click.Group(
    NAME,
    help="Tune a black-box simulator from a handful of real trials.",
    epilog="Exit status: 0; 1 where something failed, as in the simulator; 2 where the "
    "call or a file has to be changed; 10 to 14 where a gate is closed; 130 after an "
    "interrupt.",
    context_settings={"help_option_names": ["-h", "--help"]},
    no_args_is_help=False,
)
VERSION = {"message": "%(version)s", "help": "Show the version and exit."}
click.version_option(package_name=NAME, **VERSION)(program)


def command(
    *params: click.Parameter, name: str = "", group: click.Group = program, **more: Any
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Make a function a command, whose docstring is its help.

    Args:
        *params: Arguments and options of the command, in the order of the help.
        name: Name of the command; that of the function otherwise.
        group: Commands that it belongs to.
        **more: Settings of its context.
    """

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        settings = {**program.context_settings, **more}
        title = name or function.__name__.strip("_")
        help_text = function.__doc__
        group.add_command(Command(title, settings, function, [*params], help=help_text))
        return function

    return decorate


def option(
    name: str, help: str, type: Any = TEXT, metavar: str | None = None, **settings: Any
) -> click.Option:
    """Return an option.

    Args:
        name: Name with its dashes.
        help: Text that says what it does.
        type: Type of its value; None for a flag.
        metavar: Value as the help shows it.
        **settings: Further settings of :class:`click.Option`.
    """
    if isinstance(type, Several):
        settings["default"] = []
    shows = settings.get("default") not in (None, "", [])
    flag = {"is_flag": True} if type is None else {}
    settings = {**flag, "show_default": shows, **settings}
    return click.Option([name], help=help, type=type, metavar=metavar, **settings)


def argument(name: str, metavar: str, type: Any = FOLDER, **more: Any) -> Any:
    """Return an argument."""
    return click.Argument([name], metavar=metavar, type=type, **more)


INTEGER = click.INT
DIR = argument("folder", "DIR")
A_TASK = option("--task", "with all that is declared of it", click.Choice(TASKS))
OF_TASK = option(
    "--option", "of the task: variant=sinh target=2", PAIRS, "NAME=VALUE ..."
)
OF_CAMPAIGN = option(
    "--set",
    "fields of CampaignOptions: num_simulations=2000 workers.time_limit=3",
    PAIRS,
    "NAME=VALUE ...",
)
METHOD = option("--method", "by which it learns", click.Choice(METHODS), default="asbi")
SEED = option("--seed", "of all that is random", INTEGER, default=0)
ROUNDS = option("--rounds", "real trials", COUNT, default=4)
WORKERS = option("--workers", "processes", COUNT, default=1)
JSON = option("--json", "for programs, errors too", None, expose_value=False)
TRUST = option("--trust", "import what a folder from elsewhere names", None)
SIMULATOR = option(
    "--simulator", "or file.py:FUNCTION, where it is now", metavar="MODULE:FUNCTION"
)
SPACE = [
    option("--prior", "in place of bounds", metavar="MODULE:NAME"),
    option("--theta-low", "one a parameter", NUMBERS, "A,B,..."),
    option("--theta-high", "one a parameter", NUMBERS, "A,B,..."),
    option(
        "--actions",
        "for each entry LOW:HIGH, LOW:HIGH:COUNT or A,B,...; or one MODULE:NAME",
        SEVERAL,
        "SPEC ...",
    ),
    option("--noise", "standard deviation of x or its entries", NUMBERS, "SD[,SD...]"),
]
PROBLEM = [A_TASK, OF_TASK, SIMULATOR, *SPACE]
EFFECTS = option(
    "--effects", "each a list of Effect, or gives one", SEVERAL, "MODULE:NAME ..."
)


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
    found = named(ctx.command, values, str(path))
    ctx.default_map = {k: _beside(path.parent, v) for k, v in found.items()}
    return path


CONFIG = option(
    "--config",
    "with options by their names; in a folder of recordings problem.toml",
    FILE,
    "FILE.toml",
    is_eager=True,
    expose_value=False,
    callback=take_config,
)


def take_problem(ctx: click.Context, param: click.Parameter, folder: Path) -> Path:
    """Take from a folder's problem.toml what no other file and no option gives."""
    path = folder / OF_FOLDER
    if ctx.default_map is None and path.is_file():
        take_config(ctx, param, path)
    return folder


PROBLEM_FILE: Any = {"is_eager": True, "callback": take_problem}


def named(
    command: click.Command, values: Mapping[str, Any], place: str
) -> dict[str, Any]:
    """Return values of TOML or JSON by the names of a command's parameters.

    Args:
        command: The command.
        values: Values by names, with dashes or without.
        place: Place where they stand, for the error.

    Raises:
        ValueError: If a name is none of a parameter.
    """
    known = [p.name for p in command.params if p.name and p.name not in UNWRITTEN]
    found = {name.replace("-", "_"): value for name, value in values.items()}
    former = {name.replace("-", "_"): now for name, now in FORMER.items()}
    if "set" in known and (old := [name for name in found if name in former]):
        settings = [f"{former[name]}={found.pop(name)}" for name in old]
        found["set"] = [*found.get("set", []), *settings]
    for name in {*found} - {*known}:
        raise ValueError(
            f"expected options among {', '.join(sorted(known)) or 'none'}; got "
            f"{name!r} in {place}; remove it or write one of these"
        )
    return {name: value for name, value in found.items() if value is not None}


def pairs_of(texts: Sequence[str]) -> dict[str, str]:
    """Return the parts of texts NAME=VALUE.

    Raises:
        ValueError: If one is no such text.
    """
    pairs = {}
    for text in texts:
        name, _, value = text.partition("=")
        if not (name and value):
            raise ValueError(f"expected NAME=VALUE; got {text!r}; write, say, target=2")
        pairs[name] = value
    return pairs


def as_json(text: str) -> Any:
    """Return what a text is as JSON, or the text itself."""
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return text


def _beside(folder: Path, value: Any) -> Any:
    """Return what a file says, with the path of programs that lie beside it."""
    if isinstance(value, list):
        return [_beside(folder, part) for part in value]
    file, colon, name = value.partition(":") if isinstance(value, str) else ("", "", "")
    is_there = file.endswith(".py") and (folder / file).is_file()
    return f"{folder / file}{colon}{name}" if is_there else value


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

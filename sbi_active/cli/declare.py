"""The program ``sbi-active``: how commands are declared, and the types of options.

Values of options stand in words, in a file of TOML, or in a request of JSON.
"""

from __future__ import annotations

import csv
import json
import math
import re
import sys
from collections.abc import Mapping, Sequence
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
#: Options of the last version, and the settings that they are now.
FORMER = {
    "num_simulations": "num_simulations",
    "simulations": "num_simulations",
    "num_samples": "num_samples",
    "num_workers": "workers.num_workers",
    "time_limit": "workers.time_limit",
}
#: What float32 holds with all its digits, beside 0.
SMALLEST, LARGEST = 2.0**-126, 2.0**128 - 2.0**104
#: Options that no file and no request sets: where these are, and who is trusted.
UNWRITTEN = ("config", "trust", "json")
OPTION = re.compile(r"-[^\d.]")  # and no negative number


class Text(click.ParamType):
    """A text; in a file or a request also a list, or a number."""

    name = "text"

    def convert(self, value: Any, param: Any, ctx: Any) -> Any:
        """Return the text of a value."""
        text = ",".join(map(str, value)) if isinstance(value, list) else str(value)
        if text.startswith("--"):  # the next option
            said = f"Option {param.opts[0]!r} requires an argument."
            raise click.BadOptionUsage(param.opts[0], said, ctx)
        return text


class Numbers(Text):
    """Finite numbers with commas between them, or a list of these."""

    def convert(self, value: Any, param: Any, ctx: Any) -> Any:
        """Return the numbers of a value."""
        text = super().convert(value, param, ctx)
        return [number_of(part) for part in text.split(",")]


TEXT, NUMBERS, COUNT = Text(), Numbers(), click.IntRange(min=1)
FILE, FOLDER = click.Path(path_type=Path), click.Path(path_type=Path, file_okay=False)


class Command(click.Command):
    """A command whose options that may be given again take several words as well."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Set the parameters of the context by words."""
        options = {
            n: p for p in self.params if p.param_type_name == "option" for n in p.opts
        }
        words, name = [], ""
        for word in args:
            if OPTION.match(word):
                name = word.partition("=")[0]
                known = ("--", *options, *ctx.help_option_names)
                if name not in known and not ctx.resilient_parsing:
                    raise click.NoSuchOption(name, possibilities=[*options], ctx=ctx)
            elif getattr(options.get(name), "multiple", False) and words[-1] != name:
                words.append(name)
            words.append(word)
        return super().parse_args(ctx, words)


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
    *params: click.Parameter, group: click.Group = program, **settings: Any
) -> Any:
    """Return a decorator that makes a function a command, its docstring the help.

    Args:
        *params: Arguments and options of the command, in the order of the help.
        group: Commands that it belongs to.
        **settings: Settings of its context.
    """
    return group.command(cls=Command, params=[*params], context_settings=settings)


def option(
    name: str, help: str, type: Any = TEXT, metavar: str | None = None, **settings: Any
) -> click.Option:
    """Return an option.

    Args:
        name: Name with its dashes.
        help: Text that says what it does.
        type: Type of its value; None for a flag.
        metavar: Value as the help shows it; if it ends in "...", several are taken.
        **settings: Further settings of :class:`click.Option`.
    """
    shows = settings.get("default") not in (None, "")
    several = type is TEXT and bool(metavar) and str(metavar).endswith(" ...")
    settings = {"is_flag": type is None or None, "show_default": shows, **settings}
    settings |= {"help": help, "type": type, "metavar": metavar, "multiple": several}
    return click.Option([name], **settings)


def argument(name: str, metavar: str, type: Any = FOLDER, **more: Any) -> Any:
    """Return an argument."""
    return click.Argument([name], metavar=metavar, type=type, **more)


DIR = argument("folder", "DIR")
A_TASK = option("--task", "with all that is declared of it", click.Choice(TASKS))
OF_TASK = option(
    "--option", "of the task: variant=sinh target=2", metavar="NAME=VALUE ..."
)
OF_CAMPAIGN = [
    option(
        "--set",
        "fields of CampaignOptions: num_simulations=2000 workers.time_limit=3",
        metavar="NAME=VALUE ...",
    ),
    *(option(f"--{n.replace('_', '-')}", "now by --set", hidden=True) for n in FORMER),
]
METHOD = option("--method", "by which it learns", click.Choice(METHODS), default="asbi")
SEED = option("--seed", "of all that is random", int, default=0)
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
        metavar="SPEC ...",
    ),
    option("--noise", "standard deviation of x or its entries", NUMBERS, "SD[,SD...]"),
]
PROBLEM = [A_TASK, OF_TASK, SIMULATOR, *SPACE]
EFFECTS = option(
    "--effects", "each a list of Effect, or gives one", metavar="MODULE:NAME ..."
)


def take_file(
    ctx: click.Context, param: click.Parameter, path: Path | None
) -> Path | None:
    """Take from a file of TOML what the command line leaves out.

    Args:
        ctx: Context that gets the values.
        param: The option --config, or the argument of a folder, whose problem.toml
            counts where there is no other file.
        path: The file, or the folder.
    """
    if path is None or ctx.resilient_parsing:
        return path
    file = path
    if param.name != "config":
        file = path / "problem.toml"
        if ctx.default_map is not None or not file.is_file():
            return path
    if sys.version_info >= (3, 11):
        import tomllib
    else:
        import tomli as tomllib

    try:
        values = tomllib.loads(file.read_text(encoding="utf-8-sig"))
    except ValueError as error:
        raise ValueError(
            f"expected TOML in {file}; got {error}; write options as in "
            'theta-low = "0,1"'
        ) from error
    found = named(ctx.command, values, str(file))
    ctx.default_map = {name: beside(file.parent, v) for name, v in found.items()}
    return path


CONFIG = option(
    "--config",
    "with options by their names; in a folder of recordings problem.toml",
    FILE,
    "FILE.toml",
    is_eager=True,
    expose_value=False,
    callback=take_file,
)


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
    params: Any = {p.name: p for p in command.params if p.name not in UNWRITTEN}
    found = {name.replace("-", "_"): v for name, v in values.items() if v is not None}
    for name, value in found.items():
        if name not in params:
            raise ValueError(
                f"expected options among {', '.join(sorted(params)) or 'none'}; got "
                f"{name!r} in {place}; remove it or write one of these"
            )
        if params[name].multiple:
            if isinstance(
                value, dict
            ):  # as in columns = {trial = "ball", x = "height"}
                value = [f"{k}={TEXT.convert(v, None, None)}" for k, v in value.items()]
            found[name] = value if isinstance(value, list) else [value]
    return found


def beside(folder: Path, value: Any) -> Any:
    """Return options' values with the whole path of programs that lie in a folder."""
    if isinstance(value, list | tuple):
        return [beside(folder, part) for part in value]
    file, colon, name = value.partition(":") if isinstance(value, str) else ("", "", "")
    is_there = file.endswith(".py") and (folder / file).is_file()
    return f"{(folder / file).resolve()}{colon}{name}" if is_there else value


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
        value = math.inf if "_" in cell else float(cell)
    except ValueError:
        value = math.inf
    is_held = value == 0 or SMALLEST <= abs(value) <= LARGEST
    if is_held or is_outcome and math.isnan(value):
        return value
    raise ValueError(
        f"expected finite numbers; got {cell!r:.80}{place}; write them with a point, "
        "as in 1.5 or 2e-3, without a unit, and within the range of float32"
    )


def numbers_in(path: Path) -> list[float]:
    """Return the numbers of a file; an empty cell of a row was not measured.

    Raises:
        ValueError: If it is no table of numbers.
    """
    text = path.read_text(encoding="utf-8-sig", errors="replace")
    rows = [*csv.reader(text.splitlines())]
    # A heading has no cell that begins like a number: 0.84 m and 0,84;1 are none.
    begins = re.compile(r"\s*(?:[-+]?\.?\d|[-+]?(?:nan|inf)\b|$)", re.IGNORECASE)
    first = 1 if rows and not any(map(begins.match, rows[0])) else 0
    return [
        number_of(cell.strip() or "nan", f" in row {i} of {path}", is_outcome=True)
        for i, row in enumerate(rows[first:], start=first + 1)
        for cell in row
    ]

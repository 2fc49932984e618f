"""The commands of ``sbi-active`` and their options, each option declared once.

Nothing here imports torch, so that help, the version and typing errors are answered at
once. A command's module is imported when the command is called.
"""

from __future__ import annotations

import importlib
from functools import partial
from pathlib import Path
from typing import Any

import click
from click import Argument, Choice, IntRange, Option

from sbi_active.cli.options import (
    COUNT,
    FILE,
    FOLDER,
    Command,
    Several,
    take_config,
    take_problem,
    text,
)

#: Names of the tasks, as in ``sbi_active.tasks.TASKS``.
TASKS = (
    *("numerical", "oscillator", "box_collision", "pouring", "pouring_real"),
    *("servo_pendulum", "ball_drops", "location_finding", "chain"),
)
#: Names of the methods, as in ``sbi_active.campaign.learning.methods.METHODS``.
METHODS = ("asbi", "nsbi", "alhi", "nlhi", "seqbed")


def _option(
    name: str, help: str, type: Any = text, metavar: str | None = None, **settings: Any
) -> Option:
    shows = settings.get("default") not in (None, "")
    settings = {"type": type, "metavar": metavar, "show_default": shows, **settings}
    return settings.pop("kind", Option)([name], help=help, **settings)


_flag = partial(_option, type=None, is_flag=True)
_several = partial(_option, kind=Several, multiple=True)


def _argument(name: str, metavar: str, type: Any = FOLDER, **settings: Any) -> Argument:
    return Argument([name], metavar=metavar, type=type, **settings)


DIR, TRIAL = _argument("folder", "DIR"), _argument("trial", "TRIAL", int)
A_TASK = _option("--task", "with all that is declared of it", Choice(TASKS))
OF_TASK = _option(
    "--option",
    "of the task, as often as wanted: variant=sinh, target=2, noise=0.01, "
    "theta_true=[0.3,0.4,0.5]; the value is read as JSON, else as text",
    metavar="NAME=VALUE",
    multiple=True,
)
METHOD = _option("--method", "by which it learns", Choice(METHODS), default="asbi")
SEED = _option("--seed", "of all that is random", int, default=0)
ROUNDS = _option("--rounds", "real trials", COUNT, default=4)
WORKERS = _option("--workers", "processes", COUNT, default=1)
JSON = _flag("--json", "for programs, errors too")
TRUST = _flag("--trust", "import what the folder names, though it came from elsewhere")
CONFIG = _option(
    "--config",
    "options by their names without the dashes in front; in a folder of recordings "
    "problem.toml, beside which problem.py may have a simulator, prior, actions and "
    "effects",
    FILE,
    "FILE.toml",
    is_eager=True,
    callback=take_config,
)
SIMULATOR = _option(
    "--simulator",
    "or file.py:NAME; where it is now, for a campaign that knows where it was",
    metavar="MODULE:FUNCTION",
)
SPACE = [
    _option("--prior", "in place of bounds", metavar="MODULE:NAME"),
    _option("--theta-low", "one a parameter", metavar="A,B,..."),
    _option("--theta-high", "one a parameter", metavar="A,B,..."),
    _several(
        "--actions",
        "for each entry of the action LOW:HIGH (any number between), LOW:HIGH:COUNT or "
        "A,B,...; or one MODULE:NAME of an action space",
        metavar="SPEC ...",
    ),
    _option("--noise", "standard deviation of x or its entries", metavar="SD[,SD...]"),
]
EFFECTS = _option(
    "--effects",
    "a list of Effect, or a function that returns one",
    metavar="MODULE:NAME",
)
REASON = _option("--reason", "kept with the trial", default="")
OUTCOME = [
    _argument("x", "[X]...", text, nargs=-1, required=False),
    _option("--file", "with the numbers", FILE, "X.csv"),
    _flag("--invalid", "it ran and gave no measurement"),
    _flag("--missing", "a fault that tells nothing hit it"),
    _option("--action", "executed, where not the one asked for", metavar="A,B,..."),
]
RUN = [
    _argument("task", "TASK", Choice(TASKS)),
    *(METHOD, ROUNDS, SEED, OF_TASK),
    _option("--out", "folder for the results", FOLDER, "DIR", required=True),
    _option("--simulations", "to train on, a round", COUNT),
]
BUILD = [
    *(DIR, A_TASK, OF_TASK, SIMULATOR, *SPACE, SEED, WORKERS),
    _option("--simulator-version", "in place of its source code", default=""),
    _option("--rows", "in the bank, in all", COUNT, required=True),
]
CHECK = [
    _argument("simulator", "[MODULE:FUNCTION]", text, required=False),
    *(A_TASK, *SPACE, ROUNDS, WORKERS, SEED),
    _option("--rows", "a check", COUNT, default=256),
]
INIT = [
    *(DIR, CONFIG, SIMULATOR, *SPACE, EFFECTS, METHOD, SEED),
    _option("--names", "of the action's entries", metavar="A,B,..."),
    _option("--units", "of the action's entries", metavar="A,B,..."),
    _option("--num-simulations", "a round", int, "N"),
    _option("--num-samples", "a candidate action", int, "N"),
    _option("--num-workers", "processes", int, "N"),
    _option("--time-limit", "s a simulation", float, "S"),
]
CRITICIZE = [
    _argument("trials", "TRIALS.csv", FILE, is_eager=True, callback=take_problem),
    *(CONFIG, A_TASK, SIMULATOR, *SPACE, EFFECTS, SEED, TRUST, JSON),
    _several(
        "--columns",
        "columns that are trial, time, action, x, input, start, role, index or "
        "repeat_of, where they are named otherwise, as in trial=ball,drop x=height_m",
        metavar="KEY=NAME[,NAME...] ...",
    ),
    _several(
        "--units", "of columns without a unit in the header", metavar="NAME=UNIT ..."
    ),
    _option(
        "--order",
        "unknown: rows (or the column index) are not the order of execution",
        Choice(("known", "unknown")),
        default="known",
    ),
    _option(
        "--inputs",
        "inputs at times of their own: time, input_*, and trial unless all share them",
        FILE,
        "INPUTS.csv",
    ),
    _option(
        "--input-hold",
        "between two times an input has the value before, or is linear",
        Choice(("previous", "linear")),
        default="previous",
    ),
    _flag("--no-thin", "use all samples of trajectories, with measurement_sd declared"),
    _flag("--designed", "the actions were chosen for their information"),
    _option("--out", "folder for the report", FOLDER, "DIR"),
]
TRIALS_CSV = """
Find what a simulator lacks, from measured trials. Find the residual, trace it to an
effect that the simulator lacks, add it, and report the error before and after.

TRIALS.csv has one row a trial, with columns action_* and x_* and optionally role (fit
or 'held out'), index and repeat_of; or one row a sample, with columns trial and time
besides, and with input_* in place of actions that vary in time. start_* is a measured
start state. Units stand in brackets, as in x_height[m], and are those of the simulator.
An empty cell is what was not measured. In its place a folder: of a campaign, which
knows its simulator and its prior, or of recordings, with trials.csv or one file *.csv a
trial.
"""
GATE = """
Say whether a simulator may be used, as criticize finds it from the same TRIALS. Exit
status: 0 SHIP, 10 NO_IMPROVEMENT, 11 NOT_IDENTIFIABLE, 12 OUT_OF_PRIOR, 13 WRONG_MODEL,
14 NOT_ENOUGH_DATA.
"""

main = click.Group(
    "sbi-active",
    help="Tune a black-box simulator from a handful of real trials.",
    epilog="Exit status: 0; 1 where something failed, as in the simulator; 2 where the "
    "call or a file has to be changed; 130 after an interrupt.",
    context_settings={"help_option_names": ["-h", "--help"]},
    no_args_is_help=False,
)
VERSION = {"message": "%(version)s", "help": "Show the version and exit."}
click.version_option(package_name="sbi-active", **VERSION)(main)
bank = click.Group(
    "bank", help="Simulate into a bank, and inspect one.", no_args_is_help=False
)
main.add_command(bank)


def _add(
    name: str,
    help: str,
    *params: click.Parameter,
    place: str = "",
    to: click.Group = main,
) -> None:
    """Add a command; one without a place is on a campaign, and answers programs too.

    Args:
        name: Name of the command.
        help: Text that says what it does.
        *params: Arguments and options of the command.
        place: Place of its function, as ``module.name``.
        to: The commands that it belongs to.
    """
    call = partial(_call, place) if place else partial(_call_on_campaign, name)
    params = params if place else (DIR, *params, JSON, TRUST)
    # Words like -1e-3 are numbers; those that are no option are found by the command.
    settings = {"ignore_unknown_options": True, **main.context_settings}
    to.add_command(Command(name, settings, callback=call, params=[*params], help=help))


def _call(place: str, **options: Any) -> Any:
    module, function = place.split(".")
    found = importlib.import_module(f"sbi_active.cli.{module}")
    return getattr(found, function)(**options)


def _call_on_campaign(name: str, folder: Path, *, json: bool, **options: Any) -> Any:
    from sbi_active.cli.session import Session

    with click.get_current_context().obj or Session(folder) as session:
        return session.call(name, **options)


_add(
    "migrate",
    "Bring a campaign or bank of release 0.1 up to date.",
    DIR,
    place="bank.migrate",
)
_add("run", "Run a campaign on a task.", *RUN, place="run.run")
_add(
    "build",
    "Simulate into a bank, from where it ended.",
    *BUILD,
    place="bank.build",
    to=bank,
)
_add(
    "inspect",
    "Show outcomes, and compare checksums.",
    DIR,
    place="bank.inspect",
    to=bank,
)
_add(
    "check",
    "Look a simulator over before a campaign. Shapes, seeds, noise, lost rows, "
    "parameters that change nothing, and the cost of a campaign; exit status 1 where "
    "something keeps a campaign from working.",
    *CHECK,
    place="check.check",
)
_add("criticize", TRIALS_CSV, *CRITICIZE, place="criticize.criticize")
_add("gate", GATE, *CRITICIZE, place="gate.gate")
_add(
    "init",
    "Make a campaign in a new folder, also by --config.",
    *INIT,
    place="campaign.init",
)
_add(
    "ask",
    "Design the next trial, or show the pending one.",
    SIMULATOR,
    _option("--target", "theta, model or a parameter's name", default="auto"),
)
_add(
    "tell",
    "Record what a trial gave. X are the numbers, nan for one not measured.",
    *OUTCOME,
    _option("--trial", "None is the pending one, or a new one", int, "K"),
)
_add("correct", "Replace what was told of a trial.", TRIAL, *OUTCOME, REASON)
_add("withdraw", "Take a trial out of the belief.", TRIAL, REASON)
_add("status", "Show the trials, the belief and the health.")
_add("repair", "Give up what is damaged, and say what that is.")
_add(
    "update",
    "Bring the belief up to date.",
    SIMULATOR,
    _flag("--simulator-changed", "take another than before, compute all again"),
)
_add("adopt", "Go on with the effects that a verdict names.", SIMULATOR, EFFECTS)
_add(
    "report",
    "Write one page that shows the campaign.",
    _option("--out", "where to", FILE, "PAGE.html"),
)
_add(
    "export",
    "Write belief and trials for ArviZ.",
    *(SIMULATOR, SEED),
    _option("--netcdf", "where to", FILE, "FILE.nc", required=True),
)
_add(
    "serve",
    'Answer requests of a program, a JSON object a line, as {"command": "ask"}.',
    *(DIR, SIMULATOR, TRUST),
    place="session.serve",
)
_add(
    "watch",
    "Show a campaign in a browser while another process runs it. The page is drawn "
    "again when the folder changes; the folder is only read.",
    DIR,
    _option(
        "--port",
        "of this machine alone; 0 is any free one",
        IntRange(0, 65_535),
        default=8642,
    ),
    _option("--once", "write the page, and end", FILE, "FILE.html"),
    place="watch.watch",
)

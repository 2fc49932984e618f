"""The commands of ``sbi-active`` and their options, each option declared once.

Nothing here imports torch, so that help, the version and a slip of the pen are answered
at once. A command's module is imported when the command is called.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import click

from sbi_active.cli.options import (
    COUNT,
    FILE,
    FOLDER,
    SECONDS,
    TEXT,
    WHOLE,
    Command,
    Group,
    Several,
    one_of,
    take_config,
    take_problem,
)

#: Names of the tasks, as in ``sbi_active.tasks.TASKS``.
TASKS = (
    "numerical",
    "oscillator",
    "box_collision",
    "pouring",
    "pouring_real",
    "servo_pendulum",
    "ball_drops",
    "location_finding",
    "chain",
)
#: Names of the methods, as in ``sbi_active.campaign.learning.methods.METHODS``.
METHODS = ("asbi", "nsbi", "alhi", "nlhi", "seqbed")
#: Names of the settings of a method, as in ``sbi_active.cli.run.SETTINGS``.
SETTINGS = ("default", "faithful")


def _option(name: str, help: str = "", **settings: Any) -> click.Option:
    settings = {"type": TEXT, "show_default": "default" in settings, **settings}
    return click.Option([name], help=help, **settings)


def _flag(name: str, help: str) -> click.Option:
    return click.Option([name], is_flag=True, help=help)


def _several(name: str, metavar: str, help: str) -> click.Option:
    return Several([name], type=TEXT, metavar=f"{metavar} ...", help=help)


def _argument(name: str, metavar: str, type: Any = FOLDER, **settings: Any) -> Any:
    return click.Argument([name], metavar=metavar, type=type, **settings)


MODULE_NAME, A_B = {"metavar": "MODULE:NAME"}, {"metavar": "A,B,..."}
DIR, BANK = _argument("folder", "DIR"), _argument("folder", "FOLDER")
TRIAL = _argument("trial", "TRIAL", WHOLE)
TASK = _argument("task", "TASK", one_of(TASKS))
TASK_OPTION = _option(
    "--task", f"one of: {', '.join(TASKS)}", type=one_of(TASKS), metavar="TASK"
)
TASK_SETTINGS = click.Option(
    ["--option"],
    type=TEXT,
    multiple=True,
    metavar="NAME=VALUE",
    help="of the task, as often as wanted: variant=sinh, target=2, noise=0.01, "
    "theta_true=[0.3,0.4,0.5]; the value is read as JSON, else as text",
)
METHOD = _option(
    "--method",
    f"one of: {', '.join(METHODS)}",
    type=one_of(METHODS),
    default="asbi",
    metavar="METHOD",
)
SEED = _option("--seed", "of all that is random", type=WHOLE, default=0)
JSON = _flag("--json", "for programs, errors too")
TRUST = _flag("--trust", "import what the folder names, though it came from elsewhere")
CONFIG = _option(
    "--config",
    "options by their names without the dashes in front; in a folder of recordings "
    "problem.toml, beside which problem.py may have a simulator, prior, actions and "
    "effects",
    type=FILE,
    metavar="FILE.toml",
    is_eager=True,
    callback=take_config,
)
SIMULATOR = _option("--simulator", "or file.py:NAME", metavar="MODULE:FUNCTION")
SIMULATOR_NOW = _option(
    "--simulator",
    "where it is now; the campaign knows where it was",
    metavar="MODULE:FUNCTION",
)
PRIOR = _option("--prior", "in place of bounds", **MODULE_NAME)
PROBLEM = [
    PRIOR,
    _option("--theta-low", "one a parameter", **A_B),
    _option("--theta-high", "one a parameter", **A_B),
    _several(
        "--actions",
        "SPEC",
        "for each entry of the action LOW:HIGH (any number between), LOW:HIGH:COUNT or "
        "A,B,...; or one MODULE:NAME of an action space",
    ),
    _option(
        "--noise",
        "standard deviation of a measurement, one or one an entry of x, where the "
        "simulator gives none",
        metavar="SD[,SD...]",
    ),
]
EFFECTS = _option(
    "--effects",
    "that it may lack: a list of Effect, or a function that returns one",
    **MODULE_NAME,
)
OUTCOME = [
    _argument("x", "[X]...", TEXT, nargs=-1, required=False),
    _option("--file", "with the numbers", type=FILE, metavar="X.csv"),
    _flag("--invalid", "it ran and gave no measurement"),
    _flag("--missing", "a fault that tells nothing hit it"),
    _option("--action", "executed, where not the one asked for", **A_B),
]
REASON = _option("--reason", "kept with the trial", default="", show_default=False)
ROWS = _option("--rows", "a check", type=COUNT, default=256)
ROUNDS = _option("--rounds", "real trials", type=COUNT, default=4)
WORKERS = _option("--workers", "processes", type=COUNT, default=1)

main = Group(
    "sbi-active",
    help="Tune a black-box simulator from a handful of real trials.",
    epilog="Exit status: 0; 1 where something failed, as in the simulator; 2 where the "
    "call or a file has to be changed; 130 after an interrupt.",
    context_settings={"help_option_names": ["-h", "--help"]},
)
click.version_option(
    package_name="sbi-active",
    message="%(version)s",
    help="Show the version and exit.",
)(main)
bank = Group("bank", help="Simulate into a bank, and inspect one.")
main.add_command(bank)


def _call(module: str, function: str, **options: Any) -> Any:
    found = importlib.import_module(f"sbi_active.cli.{module}")
    return getattr(found, function)(**options)


def _on_campaign(name: str, folder: Path, **options: Any) -> Any:
    from sbi_active.cli.session import Session

    options.pop("json")
    held = click.get_current_context().obj.get("session")
    with held or Session(folder) as session:
        return session.call(name, **options)


def _add(name: str, callback: Callable[..., Any], help: str, *params: Any) -> None:
    group, _, own = name.rpartition(" ")
    command = Command(own, callback=callback, help=help, params=[*params])
    (bank if group else main).add_command(command)


def _add_of_campaign(name: str, help: str, *params: Any) -> None:
    _add(name, partial(_on_campaign, name), help, DIR, *params, JSON, TRUST)


_add(
    "run",
    partial(_call, "run", "run"),
    "Run a campaign on a task.",
    TASK,
    METHOD,
    ROUNDS,
    SEED,
    _option(
        "--out", "folder for the results", type=FOLDER, required=True, metavar="DIR"
    ),
    TASK_SETTINGS,
    _option(
        "--setting",
        "faithful: the paper's network and chained beliefs",
        type=one_of(SETTINGS),
        default="default",
    ),
    _option("--simulations", "to train on, a round", type=COUNT),
    _option("--samples", "for the gain, a candidate action", type=COUNT),
    _option("--iterations", "training steps a round", type=COUNT),
)
_add(
    "bank build",
    partial(_call, "bank", "build"),
    "Simulate prior draws into a bank; run again, it goes on.",
    BANK,
    TASK_OPTION,
    SIMULATOR,
    TASK_SETTINGS,
    PRIOR,
    _option("--actions", "with --simulator", **MODULE_NAME),
    _option(
        "--simulator-version",
        "yours; given, it stands for the simulator's source code",
        default="",
        show_default=False,
    ),
    _option("--rows", "in the bank, in all", type=COUNT, required=True),
    SEED,
    WORKERS,
)
_add(
    "bank inspect",
    partial(_call, "bank", "inspect"),
    "Show rows and outcomes, and compare checksums.",
    BANK,
)
_add(
    "check",
    partial(_call, "check", "check"),
    "Look a simulator over before a campaign. Shapes, seeds, noise, lost rows, "
    "parameters that change nothing, and the cost of a campaign; exit status 1 where "
    "something keeps a campaign from working.",
    _argument("simulator", "[MODULE:FUNCTION]", TEXT, required=False),
    TASK_OPTION,
    *PROBLEM,
    ROWS,
    ROUNDS,
    WORKERS,
    SEED,
)
_add(
    "criticize",
    partial(_call, "criticize", "criticize"),
    "Find what a simulator lacks, from measured trials. Find the residual, trace it to "
    "an effect that the simulator lacks, add it, and report the error before and "
    "after. TRIALS.csv has one row a trial, with columns action_* and x_* and "
    "optionally role (fit or 'held out'), index and repeat_of; or one row a sample, "
    "with columns trial and time besides, and with input_* in place of actions that "
    "vary in time. start_* is a measured start state. Units stand in brackets, as in "
    "x_height[m], and are those of the simulator. An empty cell is what was not "
    "measured. In its place a folder: of a campaign, which knows its simulator and its "
    "prior, or of recordings, with trials.csv or one file *.csv a trial.",
    _argument("trials", "TRIALS.csv", FILE, is_eager=True, callback=take_problem),
    CONFIG,
    _several(
        "--columns",
        "KEY=NAME[,NAME...]",
        "columns that are trial, time, action, x, input, start, role, index or "
        "repeat_of, where they are named otherwise, as in trial=ball,drop time=time_s "
        "x=height_m",
    ),
    _several("--units", "NAME=UNIT", "of columns without a unit in the header"),
    _option(
        "--order",
        "unknown: rows (or the column index) are not the order of execution",
        type=one_of(("known", "unknown")),
        default="known",
    ),
    _option(
        "--inputs",
        "inputs at times of their own: time, input_*, and trial unless all share them",
        type=FILE,
        metavar="INPUTS.csv",
    ),
    _option(
        "--input-hold",
        "between two times an input has the value before, or is linear",
        type=one_of(("previous", "linear")),
        default="previous",
    ),
    _flag(
        "--no-thin",
        "use all samples of trajectories, where the simulator declares the sensor's "
        "error by measurement_sd",
    ),
    TASK_OPTION,
    SIMULATOR,
    *PROBLEM,
    EFFECTS,
    _flag("--designed", "the actions were chosen for their information"),
    _option("--out", "folder for the report", type=FOLDER, metavar="DIR"),
    SEED,
    TRUST,
)
_add(
    "init",
    partial(_call, "campaign", "init"),
    "Make a campaign in a new folder. The options may stand in a TOML file, by their "
    "names without the dashes in front.",
    DIR,
    CONFIG,
    SIMULATOR,
    *PROBLEM,
    _option("--names", "of the action's entries", **A_B),
    _option("--units", "of the action's entries", **A_B),
    EFFECTS,
    METHOD,
    _option("--num-simulations", "a round", type=WHOLE, metavar="N"),
    _option("--num-samples", "a candidate action", type=WHOLE, metavar="N"),
    _option("--num-workers", "processes", type=WHOLE, metavar="N"),
    _option("--time-limit", "s a simulation", type=SECONDS, metavar="S"),
    SEED,
)
_add_of_campaign(
    "ask",
    "Design the next trial, or show the pending one.",
    SIMULATOR_NOW,
    _option(
        "--target",
        "what it should tell about: theta, model or a parameter's name",
        default="auto",
    ),
)
_add_of_campaign(
    "tell",
    "Record what a trial gave. X are the numbers, nan for one not measured.",
    *OUTCOME,
    _option("--trial", "None is the pending one, or a new one", type=WHOLE),
)
_add_of_campaign(
    "correct", "Replace what was told of a trial.", TRIAL, *OUTCOME, REASON
)
_add_of_campaign("withdraw", "Take a trial out of the belief.", TRIAL, REASON)
_add_of_campaign("status", "Show the trials, the belief and the health.")
_add_of_campaign("repair", "Give up what is damaged, and say what that is.")
_add_of_campaign(
    "update",
    "Bring the belief up to date.",
    SIMULATOR_NOW,
    _flag(
        "--simulator-changed",
        "take another simulator than before, and compute everything again",
    ),
)
_add_of_campaign(
    "adopt", "Go on with the effects that a verdict names.", SIMULATOR_NOW, EFFECTS
)
_add_of_campaign(
    "report",
    "Write one page that shows the campaign.",
    _option("--out", "where to", type=FILE, metavar="PAGE.html"),
)
_add_of_campaign(
    "export",
    "Write belief and trials for ArviZ.",
    SIMULATOR_NOW,
    _option("--netcdf", "where to", type=FILE, required=True, metavar="FILE.nc"),
    SEED,
)
_add(
    "serve",
    partial(_call, "session", "serve"),
    "Answer requests of a program. One JSON object a line comes on standard input, as "
    '{"command": "tell", "x": [0.84]}, and one goes to standard output; imports are '
    "paid for once.",
    DIR,
    SIMULATOR_NOW,
    TRUST,
)

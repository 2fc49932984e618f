"""What ``sbi-active`` understands: its commands and their options.

Nothing here imports torch, so that help, the version and a slip of the pen are answered
at once. A command's module is imported when the command is called.
"""

from __future__ import annotations

import argparse
import re
from pathlib import Path
from typing import Any

from sbi_active.cli.campaign_parser import (
    add_campaign_commands,
    add_trust,
    utf8,
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


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the whole command line.

    Parsed arguments have a ``command``: the module of :mod:`sbi_active.cli` and the
    function in it that takes them.
    """
    parser = _Parser(
        prog="sbi-active",
        description="Tune a black-box simulator from a handful of real trials.",
    )
    parser.add_argument("--version", action=_ShowVersion)
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    _add_run(commands)
    _add_bank(commands)
    migrate = commands.add_parser(
        "migrate", help="bring a campaign or bank of release 0.1 up to date"
    )
    migrate.set_defaults(command=("bank", "migrate"))
    migrate.add_argument("folder", type=Path, help="of the campaign or bank")
    _add_check(commands)
    _add_criticize(commands)
    add_campaign_commands(commands, METHODS)
    return parser


class _Parser(argparse.ArgumentParser):
    """Takes for a value what begins like a negative number, as Python 3.14 does."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        # Before, -1e-3, -.5e2 and -5,-5 were options that nobody knows.
        self._negative_number_matcher = re.compile(r"-\.?\d")


class _ShowVersion(argparse.Action):
    """Prints the version, which is looked up only then."""

    def __init__(self, option_strings: list[str], dest: str) -> None:
        super().__init__(
            option_strings, argparse.SUPPRESS, nargs=0, help="show the version and exit"
        )

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        from sbi_active import __version__

        parser.exit(message=f"{__version__}\n")


def _add_run(commands: Any) -> None:
    run = commands.add_parser("run", help="run a campaign on a task")
    run.set_defaults(command=("run", "run"))
    _add_task(run, "task")
    run.add_argument(
        "--method",
        choices=METHODS,
        default="asbi",
        metavar="METHOD",
        help=f"one of: {', '.join(METHODS)} (asbi)",
    )
    run.add_argument("--rounds", type=_count, default=4, help="real trials (4)")
    run.add_argument("--seed", type=int, default=0)
    run.add_argument("--out", type=Path, required=True, help="folder for the results")
    _add_option(run)
    run.add_argument(
        "--setting",
        choices=SETTINGS,
        default="default",
        help="faithful: the paper's network and chained beliefs",
    )
    run.add_argument("--simulations", type=_count, help="to train on, a round")
    run.add_argument("--samples", type=_count, help="for the gain, a candidate action")
    run.add_argument("--iterations", type=_count, help="training steps a round")


def _add_bank(commands: Any) -> None:
    bank = commands.add_parser("bank", help="simulate into a bank, and inspect one")
    actions = bank.add_subparsers(required=True, metavar="ACTION")
    build = actions.add_parser(
        "build",
        help="simulate prior draws into a bank; run again, it goes on",
    )
    build.set_defaults(command=("bank", "build"))
    build.add_argument("folder", type=Path, help="of the bank")
    source = build.add_mutually_exclusive_group(required=True)
    _add_task(source, "--task")
    source.add_argument("--simulator", metavar="MODULE:NAME")
    _add_option(build)
    build.add_argument("--prior", metavar="MODULE:NAME", help="with --simulator")
    build.add_argument("--actions", metavar="MODULE:NAME", help="with --simulator")
    build.add_argument(
        "--simulator-version",
        default="",
        help="yours; given, it stands for the simulator's source code",
    )
    build.add_argument("--rows", type=_count, required=True, help="in the bank, in all")
    build.add_argument("--seed", type=int, default=0)
    build.add_argument("--workers", type=_count, default=1, help="processes (1)")
    inspect = actions.add_parser(
        "inspect", help="show rows and outcomes, and compare checksums"
    )
    inspect.set_defaults(command=("bank", "inspect"))
    inspect.add_argument("folder", type=Path, help="of the bank")


def _add_check(commands: Any) -> None:
    check = commands.add_parser(
        "check",
        help="look a simulator over before a campaign",
        description=(
            "Shapes, seeds, noise, lost rows, parameters that change nothing, and the "
            "cost of a campaign. Exit status 1 where something keeps a campaign from "
            "working."
        ),
    )
    check.set_defaults(command=("check", "check"))
    check.add_argument(
        "simulator",
        nargs="?",
        metavar="MODULE:FUNCTION",
        help="or file.py:FUNCTION; not with --task",
    )
    _add_task(check, "--task")
    check.add_argument("--theta-low", metavar="A,B,...", help="one a parameter")
    check.add_argument("--theta-high", metavar="A,B,...", help="one a parameter")
    check.add_argument("--prior", metavar="MODULE:NAME", help="in place of bounds")
    check.add_argument(
        "--actions",
        nargs="+",
        metavar="SPEC",
        help="for each entry of the action LOW:HIGH:COUNT or A,B,...; or one "
        "MODULE:NAME of an action space",
    )
    check.add_argument(
        "--noise",
        metavar="SD[,SD...]",
        help="standard deviation of a measurement, one or one an entry of x, where the "
        "simulator gives none",
    )
    check.add_argument("--rows", type=_count, default=256, help="a check (256)")
    check.add_argument("--rounds", type=_count, default=4, help="of the campaign (4)")
    check.add_argument("--workers", type=_count, default=1, help="of the campaign (1)")
    check.add_argument("--seed", type=int, default=0)


def _add_criticize(commands: Any) -> None:
    criticize = commands.add_parser(
        "criticize",
        help="find what a simulator lacks, from measured trials",
        description=(
            "Compare a simulator with measured trials: find the residual, trace it to "
            "an effect that the simulator lacks, add it, and report the error before "
            "and after. TRIALS.csv has one row a trial, with columns action_* and x_* "
            "and optionally role (fit or 'held out'), index and repeat_of; or one row "
            "a sample, with columns trial and time besides, and with input_* in place "
            "of actions that vary in time. start_* is a measured start state. Units "
            "stand in brackets, as in x_height[m], and are those of the simulator. An "
            "empty cell is what was not measured."
        ),
    )
    criticize.set_defaults(command=("criticize", "criticize"), parser=criticize)
    add_trust(criticize)
    criticize.add_argument(
        "trials",
        metavar="TRIALS.csv",
        type=Path,
        help="or a folder: of a campaign, which knows its simulator and its prior, or "
        "of recordings, with trials.csv or one file *.csv a trial",
    )
    criticize.add_argument(
        "--config",
        type=Path,
        metavar="FILE.toml",
        help="options by their names without the dashes in front; in a folder of "
        "recordings problem.toml, beside which problem.py may have a simulator, prior, "
        "actions and effects",
    )
    criticize.add_argument(
        "--columns",
        type=utf8,
        nargs="+",
        metavar="KEY=NAME[,NAME...]",
        help="columns that are trial, time, action, x, input, start, role, index or "
        "repeat_of, where they are named otherwise, as in trial=ball,drop time=time_s "
        "x=height_m",
    )
    criticize.add_argument(
        "--units",
        type=utf8,
        nargs="+",
        metavar="NAME=UNIT",
        help="of columns without a unit in the header",
    )
    criticize.add_argument(
        "--order",
        choices=("known", "unknown"),
        default="known",
        help="unknown: rows (or the column index) are not the order of execution",
    )
    criticize.add_argument(
        "--inputs",
        metavar="INPUTS.csv",
        type=Path,
        help="inputs at times of their own: time, input_*, and trial unless all share "
        "them",
    )
    criticize.add_argument(
        "--input-hold",
        choices=("previous", "linear"),
        default="previous",
        help="between two times an input has the value before (default), or is linear",
    )
    criticize.add_argument(
        "--no-thin",
        action="store_true",
        help="use all samples of trajectories, where the simulator declares the "
        "sensor's error by measurement_sd",
    )
    source = criticize.add_mutually_exclusive_group()
    _add_task(source, "--task")
    source.add_argument("--simulator", metavar="MODULE:FUNCTION")
    criticize.add_argument("--prior", metavar="MODULE:NAME", help="with --simulator")
    criticize.add_argument("--theta-low", metavar="A,B,...", help="in place of --prior")
    criticize.add_argument("--theta-high", metavar="A,B,...")
    criticize.add_argument(
        "--noise",
        metavar="SD[,SD...]",
        help="standard deviation of a measurement, one or one a column of x; without "
        "it, the simulator's own, or that of at least 3 repeats of one action",
    )
    criticize.add_argument(
        "--actions",
        nargs="+",
        metavar="SPEC",
        help="the permitted ones, for the next action: for each entry LOW:HIGH:COUNT "
        "or A,B,...; or one MODULE:NAME",
    )
    criticize.add_argument(
        "--effects",
        metavar="MODULE:NAME",
        help="a list of Effect, or a function that returns one, besides the generic",
    )
    criticize.add_argument(
        "--designed",
        action="store_true",
        help="the actions were chosen for their information",
    )
    criticize.add_argument("--out", type=Path, help="folder for the report")
    criticize.add_argument("--seed", type=int, default=0)


def _add_task(parser: Any, name: str) -> None:
    parser.add_argument(
        name, choices=TASKS, metavar="TASK", help=f"one of: {', '.join(TASKS)}"
    )


def _add_option(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--option",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="of the task, as often as wanted: variant=sinh, target=2, noise=0.01, "
        "theta_true=[0.3,0.4,0.5]; the value is read as JSON, else as text",
    )


def _count(text: str) -> int:
    """Return a number of rows, rounds or processes: at least one."""
    try:
        number = int(text)
    except ValueError:
        number = 0
    if number < 1:
        raise argparse.ArgumentTypeError(f"expected a whole number >= 1; got {text!r}")
    return number

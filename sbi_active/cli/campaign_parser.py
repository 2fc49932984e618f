"""What ``sbi-active`` understands of a campaign's folder, without importing torch."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

SPACE = (
    "for each entry of the action LOW:HIGH (any number between), LOW:HIGH:COUNT or "
    "A,B,...; or one MODULE:NAME of an action space"
)


def add_campaign_commands(commands: Any, methods: Sequence[str]) -> None:
    """Add the commands that take a campaign's folder.

    Args:
        commands: Of the parser.
        methods: Names of the methods.
    """
    _add_init(commands, methods)
    ask = _command(commands, "ask", "design the next trial, or show the pending one")
    _add_simulator(ask)
    ask.add_argument(
        "--target",
        default="auto",
        help="what it should tell about: theta, model or a parameter's name (auto)",
    )
    tell = _command(commands, "tell", "record what a trial gave")
    _add_outcome(tell)
    tell.add_argument(
        "--trial", type=int, metavar="K", help="None is the pending one, or a new one"
    )
    correct = _command(commands, "correct", "replace what was told of a trial")
    correct.add_argument("trial", type=int, metavar="TRIAL", help="its number")
    _add_outcome(correct)
    correct.add_argument("--reason", type=utf8, default="", help="kept with the trial")
    withdraw = _command(commands, "withdraw", "take a trial out of the belief")
    withdraw.add_argument("trial", type=int, metavar="TRIAL", help="its number")
    withdraw.add_argument("--reason", type=utf8, default="", help="kept with the trial")
    _command(commands, "status", "show the trials, the belief and the health")
    _command(commands, "repair", "give up what is damaged, and say what that is")
    update = _command(commands, "update", "bring the belief up to date")
    _add_simulator(update)
    update.add_argument(
        "--simulator-changed",
        action="store_true",
        help="take another simulator than before, and compute everything again",
    )
    adopt = _command(commands, "adopt", "go on with the effects that a verdict names")
    _add_simulator(adopt)
    adopt.add_argument(
        "--effects", metavar="MODULE:NAME", help="that it may lack, as for criticize"
    )
    report = _command(commands, "report", "write one page that shows the campaign")
    report.add_argument("--out", type=Path, metavar="PAGE.html", help="where to")
    export = _command(commands, "export", "write belief and trials for ArviZ")
    _add_simulator(export)
    export.add_argument("--netcdf", type=Path, required=True, metavar="FILE.nc")
    export.add_argument("--seed", type=int, default=0)


def _command(commands: Any, name: str, text: str) -> argparse.ArgumentParser:
    command = commands.add_parser(name, help=text, description=text.capitalize() + ".")
    command.set_defaults(command=("campaign", name))
    command.add_argument("folder", type=Path, metavar="DIR", help="of the campaign")
    command.add_argument("--json", action="store_true", help="for programs")
    add_trust(command)
    return command


def add_trust(command: argparse.ArgumentParser) -> None:
    """Add the option that lets programs run which a folder names."""
    command.add_argument(
        "--trust",
        action="store_true",
        help="import what the folder names, though it came from elsewhere",
    )


def utf8(given: str) -> str:
    """Return a word of the command line as text, in UTF-8 whatever the locale."""
    try:
        return given.encode(errors="surrogateescape").decode()
    except UnicodeError:
        raise argparse.ArgumentTypeError(
            f"expected text in UTF-8; got {given!a}"
        ) from None


def _add_init(commands: Any, methods: Sequence[str]) -> None:
    init = commands.add_parser(
        "init",
        help="make a campaign in a new folder",
        description=(
            "Make a campaign in a new folder. The options may stand in a TOML file, by "
            "their names without the dashes in front."
        ),
    )
    init.set_defaults(command=("campaign", "init"), parser=init)
    init.add_argument("folder", type=Path, metavar="DIR", help="new or empty")
    init.add_argument("--config", type=Path, metavar="FILE.toml")
    init.add_argument("--simulator", metavar="MODULE:FUNCTION", help="or file.py:NAME")
    init.add_argument("--prior", metavar="MODULE:NAME", help="in place of bounds")
    init.add_argument("--theta-low", metavar="A,B,...", help="one a parameter")
    init.add_argument("--theta-high", metavar="A,B,...", help="one a parameter")
    init.add_argument("--actions", nargs="+", metavar="SPEC", help=SPACE)
    init.add_argument(
        "--names", type=utf8, metavar="A,B,...", help="of the action's entries"
    )
    init.add_argument(
        "--units", type=utf8, metavar="A,B,...", help="of the action's entries"
    )
    init.add_argument(
        "--noise",
        metavar="SD[,SD...]",
        help="standard deviation of a measurement, one or one an entry of x, where the "
        "simulator gives none",
    )
    init.add_argument("--effects", metavar="MODULE:NAME", help="that it may lack")
    init.add_argument("--method", choices=methods, default="asbi")
    init.add_argument("--num-simulations", type=int, metavar="N", help="a round")
    init.add_argument("--num-samples", type=int, metavar="N", help="a candidate action")
    init.add_argument("--num-workers", type=int, metavar="N", help="processes")
    init.add_argument("--time-limit", type=float, metavar="S", help="s a simulation")
    init.add_argument("--seed", type=int, default=0)


def _add_outcome(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "x", nargs="*", metavar="X", help="the numbers, nan for one not measured"
    )
    command.add_argument("--file", type=Path, metavar="X.csv", help="with the numbers")
    command.add_argument(
        "--invalid", action="store_true", help="it ran and gave no measurement"
    )
    command.add_argument(
        "--missing", action="store_true", help="a fault that tells nothing hit it"
    )
    command.add_argument(
        "--action", metavar="A,B,...", help="executed, where not the one asked for"
    )


def _add_simulator(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--simulator",
        metavar="MODULE:FUNCTION",
        help="where it is now; the campaign knows where it was",
    )

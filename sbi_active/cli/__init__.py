"""The command line ``sbi-active``: one command a module."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from sbi_active import __version__
from sbi_active.cli import bank, check, criticize, run

__all__ = ["main"]

#: Modules with ``add_parser(commands)``, in the order of the help text.
COMMANDS = (run, bank, check, criticize)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        argv: Arguments; None takes those of the process.

    Returns:
        The exit status.
    """
    arguments = _parser().parse_args(argv)
    try:
        return arguments.command(arguments)
    except (ValueError, OSError) as error:
        print(f"sbi-active: {error}", file=sys.stderr)
        return 2


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="sbi-active",
        description="Tune a black-box simulator from a handful of real trials.",
    )
    parser.add_argument("--version", action="version", version=__version__)
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for module in COMMANDS:
        module.add_parser(commands)
    return parser

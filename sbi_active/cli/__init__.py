"""The command line ``sbi-active``.

Here live the parser, and one module a command, which reads its arguments, calls the
library and prints. Nothing that a user of Python might want lives here.
"""

from __future__ import annotations

import importlib
import warnings
from collections.abc import Sequence

from sbi_active.cli.parser import make_parser
from sbi_active.cli.words import say

__all__ = ["main"]


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        argv: Arguments; None takes those of the process.

    Returns:
        The exit status.
    """
    arguments = make_parser().parse_args(argv)
    module, function = arguments.command
    command = getattr(importlib.import_module(f"sbi_active.cli.{module}"), function)
    folder = getattr(arguments, "folder", getattr(arguments, "trials", "DIR"))
    try:
        with warnings.catch_warnings():
            warnings.showwarning = lambda message, *_: say(f"note: {message}", folder)
            return command(arguments)
    except (ValueError, OSError) as error:
        say(str(error), folder)
        return 2

"""The command line ``sbi-active``.

Here live the parser, and one module a command, which reads its arguments, calls the
library and prints. Nothing that a user of Python might want lives here.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence

from sbi_active.cli.parser import make_parser

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
    try:
        return command(arguments)
    except (ValueError, OSError) as error:
        print(f"sbi-active: {error}", file=sys.stderr)
        return 2

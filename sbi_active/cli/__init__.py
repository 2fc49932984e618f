"""The command line ``sbi-active``.

Here live the parser, and one module a command, which reads its arguments, calls the
library and prints. Nothing that a user of Python might want lives here.
"""

from __future__ import annotations

import importlib
import os
import sys
import traceback
import warnings
from collections.abc import Sequence
from contextlib import nullcontext

from sbi_active.cli.parser import make_parser
from sbi_active.cli.words import answering, say

__all__ = ["main"]


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        argv: Arguments; None takes those of the process.

    Returns:
        The exit status: 0, 1 where something was found that is not right, 2 after an
        error, 130 after an interrupt.
    """
    arguments = make_parser().parse_args(argv)
    module, function = arguments.command
    command = getattr(importlib.import_module(f"sbi_active.cli.{module}"), function)
    folder = getattr(arguments, "folder", getattr(arguments, "trials", "DIR"))
    is_json = getattr(arguments, "json", False)
    try:
        with warnings.catch_warnings(), answering() if is_json else nullcontext():
            warnings.showwarning = lambda message, *_: say(f"note: {message}", folder)
            return command(arguments)
    except KeyboardInterrupt:
        say("interrupted; what was told is on the disk, the rest is computed again", "")
        return 130
    except BrokenPipeError:  # of a reader that has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except (ValueError, OSError) as error:
        say(str(error), folder)
        return 2
    except Exception as error:  # of a simulator, or of an option of another type
        place = traceback.extract_tb(error.__traceback__)[-1]
        say(
            f"{type(error).__name__}: {error} (in {place.name}, {place.filename}, line "
            f"{place.lineno})",
            folder,
        )
        return 2

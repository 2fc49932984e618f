"""The command line ``sbi-active``.

Here live the parser, and one module a command, which reads its arguments, calls the
library and prints. Nothing that a user of Python might want lives here.
"""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import importlib
import json
import os
import sys
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path

from sbi_active.cli.declared import in_campaign
from sbi_active.cli.parser import make_parser
from sbi_active.cli.words import as_json, place_of, say

__all__ = ["main"]

FAILED, MISUSED, INTERRUPTED = 1, 2, 130


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        argv: Arguments; None takes those of the process.

    Returns:
        The exit status: 0, 1 where something failed, 2 where the call or a file has to
        be changed, 130 after an interrupt.
    """
    arguments = make_parser().parse_args(argv)
    folder = getattr(arguments, "folder", getattr(arguments, "trials", "DIR"))
    try:
        with contextlib.suppress(AttributeError, ValueError):
            # A terminal that has no such letter shows its number.
            sys.stdout.reconfigure(errors="backslashreplace")  # type: ignore
        _leave_out_campaigns()
        with warnings.catch_warnings():
            warnings.showwarning = lambda message, *_: say(f"note: {message}", folder)
            status = _run(arguments)
        if sys.stdout is not None:
            sys.stdout.flush()
        return status
    except BrokenPipeError:  # as in "| head": nobody reads on
        status = FAILED
    except KeyboardInterrupt as error:
        say(f"{str(error) or 'interrupted'}; what was told before is kept", folder)
        status = INTERRUPTED
    except (ValueError, OSError) as error:
        say(str(error), folder)
        status = MISUSED
    except Exception as error:  # of a simulator, or a fault of this library
        say(f"{type(error).__name__}: {error}{place_of(error)}", folder)
        status = FAILED
    _flush()
    return status


def _run(arguments: argparse.Namespace) -> int:
    """Run a command; the answer for programs has standard output for itself."""
    module, function = arguments.command
    is_json = getattr(arguments, "json", False)
    with _output_to_errors() if is_json else contextlib.nullcontext():
        command = getattr(importlib.import_module(f"sbi_active.cli.{module}"), function)
        status = command(arguments)
    if is_json:
        print(json.dumps(as_json(arguments.answer), allow_nan=False))
    return status


@contextlib.contextmanager
def _output_to_errors() -> Iterator[None]:
    """Send to standard error what simulators print, in C and in workers too."""
    with contextlib.redirect_stdout(sys.stderr), contextlib.ExitStack() as undo:
        with contextlib.suppress(OSError):  # one of them is closed
            kept = os.dup(1)
            undo.callback(os.close, kept)
            os.dup2(2, 1)
            undo.callback(os.dup2, kept, 1)
            undo.callback(_flush_c)
        yield


def _flush_c() -> None:
    with contextlib.suppress(Exception):  # a platform without it
        ctypes.CDLL(None).fflush(None)


def _leave_out_campaigns() -> None:
    """Import nothing from a campaign's folder because somebody stands in it."""
    here = Path.cwd()
    if in_campaign(here):
        sys.path[:] = [p for p in sys.path if p and Path(p).resolve() != here]


def _flush() -> None:
    """Write what is left, so that the end of the process has nothing to complain of."""
    try:
        sys.stdout.flush()
    except OSError:
        with contextlib.suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except AttributeError:
        pass  # closed from the start

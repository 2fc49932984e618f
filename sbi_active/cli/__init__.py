"""The command line ``sbi-active``.

This package contains the commands with their options, and one module for each kind of
them, which takes options, calls the library and prints. It contains nothing that a user
of Python might need.
"""

from __future__ import annotations

import contextlib
import os
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from click.exceptions import Exit
from click.shell_completion import shell_complete

from sbi_active.cli.commands import main as program
from sbi_active.cli.declared import in_campaign
from sbi_active.cli.output import (
    FAILED,
    Answer,
    as_line,
    failure,
    flush,
    output_to_errors,
    say,
)

__all__ = ["main"]

NAME, COMPLETE = "sbi-active", "_SBI_ACTIVE_COMPLETE"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        argv: Arguments; None takes those of the process.

    Returns:
        The exit status: 0, 1 where something failed, 2 where the call or a file has to
        be changed, 10 to 14 where a gate is closed, 130 after an interrupt.
    """
    words = sys.argv[1:] if argv is None else [*argv]
    shell = os.environ.get(COMPLETE)
    if shell:
        return shell_complete(program, {}, NAME, COMPLETE, shell)
    is_json, answer = "--json" in words, None
    with contextlib.suppress(AttributeError, ValueError):
        # A terminal that has no such letter shows its number.
        sys.stdout.reconfigure(errors="backslashreplace")  # type: ignore
    try:
        _leave_out_campaigns()
        answer = _answer(words, is_json)
        if isinstance(answer, Answer):
            print(as_line(answer.data) if is_json else answer.text)
        if sys.stdout is not None:
            sys.stdout.flush()
        return answer if isinstance(answer, int) else getattr(answer, "status", 0)
    except Exit as ended:  # of help and version
        return ended.exit_code
    except BrokenPipeError:  # as in "| head": nobody reads on
        status = FAILED
    except (Exception, KeyboardInterrupt) as error:
        found = failure(error)
        status = found["status"]
        say(found["message"])
        if is_json and answer is None:
            with contextlib.suppress(OSError, ValueError):
                print(as_line({"error": found}))
    flush()
    return status


def _answer(words: list[str], is_json: bool) -> Any:
    """Run a command; the answer for programs has standard output for itself."""
    with (
        output_to_errors() if is_json else contextlib.nullcontext(),
        warnings.catch_warnings(),
    ):
        warnings.showwarning = lambda message, *_: say(f"note: {message}")
        with program.make_context(NAME, words) as context:
            return program.invoke(context)


def _leave_out_campaigns() -> None:
    """Import nothing from a campaign's folder because somebody stands in it."""
    here = Path.cwd()
    if in_campaign(here):
        sys.path[:] = [p for p in sys.path if p and Path(p).resolve() != here]

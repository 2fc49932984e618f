"""The command line ``sbi-active``.

Here live the commands with their options, and one module for those alike, which takes
options, calls the library and prints. Nothing that a user of Python might want lives
here.
"""

from __future__ import annotations

import contextlib
import json
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
from sbi_active.cli.words import (
    FAILED,
    Answer,
    as_json,
    failure,
    failure_json,
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
        be changed, 130 after an interrupt.
    """
    words = sys.argv[1:] if argv is None else [*argv]
    shell = os.environ.get(COMPLETE)
    if shell:
        return shell_complete(program, {}, NAME, COMPLETE, shell)
    options: dict[str, Any] = {}
    answer: Any = None
    with contextlib.suppress(AttributeError, ValueError):
        # A terminal that has no such letter shows its number.
        sys.stdout.reconfigure(errors="backslashreplace")  # type: ignore
    try:
        _leave_out_campaigns()
        answer = _answer(words, options)
        if isinstance(answer, Answer):
            text = json.dumps(as_json(answer.data), allow_nan=False)
            print(text if options["json"] else answer.text)
        if sys.stdout is not None:
            sys.stdout.flush()
        return answer if isinstance(answer, int) else 0
    except Exit as ended:  # of help and version
        return ended.exit_code
    except BrokenPipeError:  # as in "| head": nobody reads on
        status = FAILED
    except (Exception, KeyboardInterrupt) as error:
        status, text = failure(error)
        say(text, _folder(options))
        if "--json" in words and not isinstance(answer, Answer):
            with contextlib.suppress(OSError, ValueError):
                print(json.dumps(failure_json(error, _folder(options))))
    flush()
    return status


def _answer(words: list[str], options: dict[str, Any]) -> Any:
    """Run a command; the answer for programs has standard output for itself."""
    is_json = "--json" in words
    with (
        output_to_errors() if is_json else contextlib.nullcontext(),
        warnings.catch_warnings(),
    ):
        warnings.showwarning = lambda message, *_: say(
            f"note: {message}", _folder(options)
        )
        with program.make_context(NAME, words, obj=options) as context:
            return program.invoke(context)


def _folder(options: dict[str, Any]) -> object:
    return options.get("folder", options.get("trials", "DIR"))


def _leave_out_campaigns() -> None:
    """Import nothing from a campaign's folder because somebody stands in it."""
    here = Path.cwd()
    if in_campaign(here):
        sys.path[:] = [p for p in sys.path if p and Path(p).resolve() != here]

"""The command line ``sbi-active``.

This package contains the commands, each a function whose options are declared above it
and whose docstring is its help. It contains nothing that a user of Python might need.
Nothing in it imports torch before a command needs it: commands import what they call.
"""

from __future__ import annotations

import contextlib
import logging
import os
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path

from click.exceptions import Exit
from click.shell_completion import shell_complete

from sbi_active.cli import declare as cli

__all__ = ["main"]


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        argv: Arguments; None takes those of the process.

    Returns:
        The exit status: 0, 1 where something failed, 2 where the call or a file has to
        be changed, 10 to 14 where a gate is closed, 130 after an interrupt.
    """
    words = sys.argv[1:] if argv is None else [*argv]
    here = Path.cwd()  # nothing is imported because it lies there
    sys.path[:] = [p for p in sys.path if p and Path(p).resolve() != here]
    from sbi_active.cli import campaign, simulators  # noqa: F401

    if shell := os.environ.get(variable := "_SBI_ACTIVE_COMPLETE"):
        return shell_complete(cli.program, {}, cli.NAME, variable, shell)
    is_json = "--json" in words
    logging.getLogger("sbi_active").setLevel(logging.INFO)
    progress = logging.StreamHandler()  # what takes long is said on standard error
    progress.setFormatter(logging.Formatter("sbi-active: %(message)s"))
    logging.getLogger("sbi_active").handlers = [progress]
    with contextlib.suppress(AttributeError, ValueError):
        # A terminal that has no such letter shows its number.
        sys.stdout.reconfigure(errors="backslashreplace")  # type: ignore
    # The answer for programs has standard output for itself.
    apart = cli.output_to_errors() if is_json else contextlib.nullcontext()
    try:
        # Words are UTF-8, whatever the locale.
        words = [word.encode(errors="surrogateescape").decode() for word in words]
        with apart, warnings.catch_warnings():
            warnings.showwarning = lambda message, *_: cli.say(f"note: {message}")
            with cli.program.make_context(cli.NAME, words) as context:
                answer = cli.program.invoke(context) or cli.Answer({}, "")
        if answer.text:
            print(cli.as_line(answer.data) if is_json else answer.text, flush=True)
        return answer.status
    except Exit as ended:  # of help and version
        return ended.exit_code
    except (Exception, KeyboardInterrupt) as raised:
        error = cli.failure(raised)
    if error["type"] != "BrokenPipeError":  # as in "| head": nobody reads on
        cli.say(error["message"])
    shown = f"{cli.as_line({'error': error})}\n" if is_json else ""
    try:
        print(shown, end="", flush=True)
    except OSError:  # the end of the process has then nothing to complain of
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    return error["status"]

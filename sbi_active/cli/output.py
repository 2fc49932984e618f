"""Output of a command: answers, notes, errors."""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import re
import sys
import traceback
from collections.abc import Iterator
from typing import Any, NamedTuple

import click

from sbi_active.plain import plain

FAILED, MISUSED, INTERRUPTED = 1, 2, 130
#: What a worker says of an error: of its frames the last counts.
TRACEBACK = re.compile(
    r"Traceback \(most recent call last\):\n"
    r'(?: .*\n)*  File "(.*)", line (\d+).*\n(?: .*\n)*(.*)'
)


class Answer(NamedTuple):
    """The answer of a command.

    Attributes:
        data: Data for programs; numbers that are not finite become null.
        text: Text for people.
        status: Exit status.
    """

    data: dict[str, Any]
    text: str
    status: int = 0


def say(said: object) -> None:
    """Print a note or an error to standard error."""
    if sys.stderr is not None:
        print(f"sbi-active: {said}", file=sys.stderr)


def failure(error: BaseException) -> dict[str, Any]:
    """Return an error for programs: its class, its text, and the exit status."""
    status, text = FAILED, located(error)
    if isinstance(error, KeyboardInterrupt):
        status = INTERRUPTED
        text = f"{str(error) or 'interrupted'}; what was told before is kept"
    elif isinstance(error, click.ClickException):
        status, text = MISUSED, error.format_message()
    elif isinstance(error, ValueError | OSError):
        status = FAILED if isinstance(error, BrokenPipeError) else MISUSED
        text = str(error)
    message = TRACEBACK.sub(r"\3 (\1, line \2)", text)
    return {"type": type(error).__name__, "message": message, "status": status}


def located(error: BaseException) -> str:
    """Return the class and the text of an error, and where it was raised."""
    text, frames = f"{type(error).__name__}: {error}", error.__traceback__
    if isinstance(error, SyntaxError) or frames is None:  # whose text has it
        return text
    last = traceback.extract_tb(frames)[-1]
    return f"{text} ({last.filename}, line {last.lineno})"


def as_line(value: Any) -> str:
    """Return an answer as one line of JSON, null for a number that is not finite."""
    return json.dumps(plain(value), allow_nan=False)


@contextlib.contextmanager
def output_to_errors() -> Iterator[None]:
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

"""What the library says, in the words of the command line, and where that goes."""

from __future__ import annotations

import contextlib
import ctypes
import math
import os
import re
import sys
import traceback
from collections.abc import Iterator
from typing import Any, NamedTuple

import click

from sbi_active.cli.options import in_words

FAILED, MISUSED, INTERRUPTED = 1, 2, 130

#: What the library says to users of Python, and what that is on the command line.
WORDS = (
    (r"tell\(x, trial=(\d+)\)", r"sbi-active correct DIR \1 X"),
    (r"withdraw\((\d+)\)", r"sbi-active withdraw DIR \1"),
    (r"criticize\(\)", "sbi-active criticize DIR"),
    (r"update\(\)", "sbi-active update DIR"),
    (r"Campaign\(\.\.\., directory=\.\.\.\)", "sbi-active init DIR"),
    (r"Campaign\.load\(directory, simulator=\.\.\.\)", "sbi-active ask DIR"),
    (r"ask\(\)", "sbi-active ask DIR"),
    (r"load the campaign with repair=True", "run sbi-active repair DIR"),
    (r"load the campaign with prior=", "add --trust"),
    (r"simulator_changed=True", "sbi-active update DIR --simulator-changed"),
)


class Answer(NamedTuple):
    """What a command found.

    Attributes:
        data: For programs; numbers that are not finite become null.
        text: For people.
    """

    data: dict[str, Any]
    text: str


def spoken(text: str, folder: object) -> str:
    """Return a text of the library as somebody at the command line needs it.

    Args:
        text: It names methods of Python.
        folder: Of the campaign.
    """
    place = str(folder).replace("\\", r"\\")
    for of_python, of_command_line in WORDS:
        text = re.sub(of_python, of_command_line.replace("DIR", place), text)
    return text


def say(text: str, folder: object) -> None:
    """Print a text of the library to standard error."""
    if sys.stderr is not None:
        print(f"sbi-active: {spoken(_briefly(text), folder)}", file=sys.stderr)


def _briefly(text: str) -> str:
    """Return a text with the last line of each traceback in it, and its place."""

    def last(found: re.Match[str]) -> str:
        frames = re.findall(r'File "(.*)", line (\d+)', found[0])
        return found[1] + (f" ({', line '.join(frames[-1])})" if frames else "")

    return re.sub(r"Traceback \(most recent call last\):\n(?: .*\n)*(.*)", last, text)


def failure(error: BaseException) -> tuple[int, str]:
    """Return the exit status of an error, and its text."""
    if isinstance(error, KeyboardInterrupt):
        text = f"{str(error) or 'interrupted'}; what was told before is kept"
        return INTERRUPTED, text
    if isinstance(error, click.ClickException):
        return MISUSED, in_words(error)
    if isinstance(error, ValueError | OSError):
        return MISUSED, str(error)
    # Of a simulator, or a fault of this library.
    return FAILED, f"{type(error).__name__}: {error}{place_of(error)}"


def failure_json(error: BaseException, folder: object) -> dict[str, Any]:
    """Return an error as JSON: its class, its text, and its exit status."""
    status, text = failure(error)
    kind, message = type(error).__name__, spoken(_briefly(text), folder)
    return {"error": {"type": kind, "message": message, "status": status}}


def place_of(error: BaseException) -> str:
    """Return where an error was raised, to be added to its text."""
    frames = traceback.extract_tb(error.__traceback__)
    if isinstance(error, SyntaxError) or not frames:  # whose text has it
        return ""
    return f" ({frames[-1].filename}, line {frames[-1].lineno})"


def as_json(value: Any) -> Any:
    """Return an answer as JSON has it: null for a number that is not finite."""
    if isinstance(value, dict):
        return {key: as_json(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [as_json(part) for part in value]
    is_number = not isinstance(value, float) or math.isfinite(value)
    return value if is_number else None


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


def flush() -> None:
    """Write what is left, so that the end of the process has nothing to complain of."""
    try:
        sys.stdout.flush()
    except OSError:
        with contextlib.suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except AttributeError:
        pass  # closed from the start

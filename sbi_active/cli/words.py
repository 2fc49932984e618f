"""What the library says, in the words of the command line."""

from __future__ import annotations

import json
import math
import re
import sys
from contextlib import redirect_stdout
from typing import Any, TextIO

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
)


def spoken(text: str, folder: object) -> str:
    """Return a text of the library as somebody at the command line needs it.

    Args:
        text: It names methods of Python.
        folder: Of the campaign.
    """
    for of_python, of_command_line in WORDS:
        command = of_command_line.replace("DIR", str(folder))
        text = re.sub(of_python, command, text)
    return text


def say(text: str, folder: object) -> None:
    """Print a text of the library to standard error."""
    print(f"sbi-active: {spoken(text, folder)}", file=sys.stderr)


_answers: list[TextIO] = []


class answering(redirect_stdout):  # noqa: N801, a context manager as its base is
    """Keep standard output for one answer: what else is printed goes to the errors."""

    def __init__(self) -> None:
        super().__init__(sys.stderr)

    def __enter__(self) -> Any:
        _answers.append(sys.stdout)
        return super().__enter__()

    def __exit__(self, *details: Any) -> None:
        super().__exit__(*details)
        _answers.pop()


def answer(value: Any) -> None:
    """Print an answer for programs, as JSON: what is no finite number is null."""
    text = json.dumps(_plain(value), allow_nan=False)
    print(text, file=_answers[-1] if _answers else sys.stdout)


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value

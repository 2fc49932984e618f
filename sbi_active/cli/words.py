"""What the library says, in the words of the command line."""

from __future__ import annotations

import math
import re
import sys
import traceback
from typing import Any

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

"""What the library says, in the words of the command line."""

from __future__ import annotations

import re
import sys

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

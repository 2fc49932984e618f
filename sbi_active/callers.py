"""The user's line that called the package, at which warnings point."""

from __future__ import annotations

import sys
from pathlib import Path

PACKAGE = f"{Path(__file__).parent}/"


def stack_level() -> int:
    """Return the ``stacklevel`` of a warning that points out of the package.

    Call it in the function that gives the warning.
    """
    frame, level = sys._getframe(1), 1
    while frame.f_back is not None and frame.f_code.co_filename.startswith(PACKAGE):
        frame, level = frame.f_back, level + 1
    return level

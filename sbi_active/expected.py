"""Errors of arguments, in one form of words for all settings."""

from __future__ import annotations

from typing import Any


def require(holds: bool, expected: str, got: Any, advice: str) -> None:
    """Raise if a setting is not what it has to be.

    Args:
        holds: Whether it is.
        expected: Name and range of the setting.
        got: Value that was given.
        advice: Advice on what to do.

    Raises:
        ValueError: If it does not hold, with all three in its text.

    Example:
        >>> require(False, "num_rows >= 1", 0, "use some thousand")
        Traceback (most recent call last):
        ValueError: expected num_rows >= 1; got 0; use some thousand
    """
    if not holds:
        raise ValueError(f"expected {expected}; got {got}; {advice}")

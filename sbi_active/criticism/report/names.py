"""Names in a row, those of trials, and those of the entries of an action."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np


def joined(names: Sequence[str] | frozenset[str]) -> str:
    """Return names in a row, those of a set as equal."""
    if isinstance(names, frozenset):
        return " = ".join(sorted(names))
    return ", ".join(names)


def called(names: Sequence[str], position: int) -> str:
    """Return the name of a trial, or its position without names."""
    return names[position] if names else str(position)


def setting(labels: Sequence[str], action: np.ndarray) -> str:
    """Return an action in words, each entry with its name and unit.

    Example:
        >>> setting(["speed [m/s]", "tilt"], np.array([2.5, 0.125]))
        'speed = 2.5 m/s, tilt = 0.125'
    """
    return ", ".join(
        f"{name} = {value:.4g} {unit}".rstrip()
        for (name, unit), value in zip(named_entries(labels), action, strict=True)
    )


def named_entries(labels: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Yield name and unit of each entry of the action, "" without a unit."""
    for label in labels:
        name, _, unit = label.partition(" [")
        yield name, unit.removesuffix("]")

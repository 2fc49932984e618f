"""A part of a report, apart from how it is set."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

__all__ = ["Section", "joined"]


@dataclass(frozen=True)
class Section:
    """A part of a report.

    Attributes:
        title: Its heading.
        text: Paragraphs.
        items: A list of points.
        header: Of the table.
        rows: Of the table, cells as text.
        figure: Name of the figure.
    """

    title: str
    text: tuple[str, ...] = ()
    items: tuple[str, ...] = ()
    header: tuple[str, ...] = ()
    rows: tuple[tuple[str, ...], ...] = ()
    figure: str | None = None


def joined(names: Sequence[str] | frozenset[str]) -> str:
    """Return names in a row, those of a set as equal."""
    if isinstance(names, frozenset):
        return " = ".join(sorted(names))
    return ", ".join(names)

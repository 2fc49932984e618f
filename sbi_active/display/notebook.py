"""Small pieces of HTML for notebooks: escaped, self-contained, on light and dark."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import cache
from typing import Any

from sbi_active.display.page import templates
from sbi_active.display.table import Table


def card(title: object, *parts: object) -> str:
    """Return a titled block of parts: text, or what the functions here return."""
    return _pieces().card(title, parts)


def table(shown: Table) -> str:
    """Return a table of at most 30 rows; nothing for none."""
    return _pieces().table(shown)


def facts(pairs: Iterable[tuple[object, object]]) -> str:
    """Return names with what they are, those that are None left out."""
    return _pieces().facts(pairs)


def items(texts: Sequence[object]) -> str:
    """Return a list of sentences; nothing for none."""
    return _pieces().items(texts)


def badge(text: object, kind: str = "plain") -> str:
    """Return a word in a frame of the color of "good", "fair", "bad" or "plain"."""
    return _pieces().badge(text, kind)


@cache
def _pieces() -> Any:
    return templates().get_template("notebook.html.jinja").module

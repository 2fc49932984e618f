"""Entries of docstrings name a noun: "seed: Seed of all draws.", not "seed: Of all"."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[2]
LIBRARY = ROOT / "sbi_active"
ENTRY = re.compile(r"^\s+[*\w]+: (?:Of|As|Alike|Likewise|The same)\b")


def docstrings(text: str) -> Iterator[tuple[int, str]]:
    """First line and text of every docstring of a file."""
    kinds = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, kinds) and ast.get_docstring(node) is not None:
            first = node.body[0]
            lines = text.split("\n")[first.lineno - 1 : first.end_lineno]
            yield first.lineno, "\n".join(lines)


def without_noun(text: str) -> list[tuple[int, str]]:
    """Line and text of the entries of a file's docstrings that begin with no noun."""
    return [
        (first + number, line.strip())
        for first, doc in docstrings(text)
        for number, line in enumerate(doc.split("\n"))
        if ENTRY.match(line)
    ]


def test_entries_of_docstrings_begin_with_a_noun():
    places = [
        f"{path.relative_to(ROOT)}:{number}: {line}"
        for path in sorted(LIBRARY.rglob("*.py"))
        for number, line in without_noun(path.read_text(encoding="utf-8"))
    ]
    assert not places, "begin these entries with a noun:\n" + "\n".join(places)


def test_an_entry_without_a_noun_is_found():
    text = '''def f(seed, names):
    """Return nothing.

    Args:
        seed: Of all draws.
        names: Names of the parameters.
        **options: As in g.
    """
    text = "seed: Of all draws."
'''
    found = [(5, "seed: Of all draws."), (7, "**options: As in g.")]
    assert without_noun(text) == found

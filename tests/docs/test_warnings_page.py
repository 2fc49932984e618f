"""Every warning of the library has its place on the page about warnings."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
LIBRARY = ROOT / "sbi_active"
PAGE = (ROOT / "docs" / "howto" / "warnings.md").read_text(encoding="utf-8")
PHRASES = re.findall(r"^### `(.+)`$", PAGE, re.MULTILINE)
FORWARDED = 2  # calls whose text comes from where it is named on the page, or an error


def constants(node: ast.AST) -> str:
    """Return the fixed words of a text, what is filled in left out."""
    parts = [
        n.value
        for n in ast.walk(node)
        if isinstance(n, ast.Constant) and isinstance(n.value, str)
    ]
    return "".join(parts)


def files() -> list[Path]:
    return [p for p in sorted(LIBRARY.rglob("*.py")) if "tasks" not in p.parts]


def given() -> list[tuple[str, str]]:
    """Return the texts of all warnings that are given, with their files."""
    found = []
    for path in files():
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            called = isinstance(node, ast.Call) and ast.unparse(node.func)
            if called == "warnings.warn":
                found.append((path.name, constants(node.args[0])))
            elif isinstance(node, ast.Yield) and path.name == "cautions.py":
                assert node.value is not None
                found.append((path.name, constants(node.value)))
    return found


def named() -> set[str]:
    """Return the names of the library's own errors and warnings."""
    return {
        node.name
        for path in files()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.ClassDef)
        and node.bases  # an error of a fit is none
        and re.search("(Error|Warning|Interrupted)$", node.name)
    }


@pytest.mark.parametrize(("file", "text"), given(), ids=lambda v: v[:40])
def test_every_warning_has_its_anchor(file, text):
    if text:
        assert [p for p in PHRASES if p in text], f"{file}: {text}"


def test_few_warnings_have_no_words_of_their_own():
    assert sum(not text for _, text in given()) <= FORWARDED


def test_every_anchor_is_said_somewhere():
    """A phrase whose warning was reworded is found, also of diagnostics."""
    texts = [constants(ast.parse(p.read_text(encoding="utf-8"))) for p in files()]
    everything = " ".join(" ".join(texts).split())
    assert [p for p in PHRASES if " ".join(p.split()) not in everything] == []
    assert len({*PHRASES}) == len(PHRASES)


@pytest.mark.parametrize("name", sorted(named()))
def test_every_class_is_explained(name):
    assert f"`{name}`" in PAGE

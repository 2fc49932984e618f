"""Every warning and error of the library names its place on the page about warnings."""

import ast
import importlib
import re
import warnings
from pathlib import Path

import pytest
import torch

from sbi_active.criticism import Trials
from sbi_active.inference.beliefs.diagnostics import Diagnostics
from sbi_active.messages import ANCHORS, PAGE, Explained, explained

ROOT = Path(__file__).parents[2]
LIBRARY = ROOT / "sbi_active"
TEXT = (ROOT / "docs" / "howto" / "warnings.md").read_text(encoding="utf-8")
HEADINGS = dict(re.findall(r"^\(([\w-]+)\)=\n### `(.+)`$", TEXT, re.MULTILINE))
PLACE = re.compile(rf"\(see {PAGE}#([\w-]+)\)$")
#: Whose texts are warnings: what is yielded there is one sentence of a report each.
YIELDED = {"cautions.py", "suspects.py", "given.py"}
FORWARDED = 2  # calls whose text comes from where it is named in ANCHORS, or an error
#: Errors that another one of the library says in its own words.
CAUGHT = 9


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


def nodes() -> list[tuple[Path, ast.AST]]:
    return [
        (path, node)
        for path in files()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
    ]


def given() -> list[tuple[str, str]]:
    """Return the texts of all warnings that are given, with their files."""
    found = []
    for path, node in nodes():
        called = ast.unparse(node.func) if isinstance(node, ast.Call) else ""
        if isinstance(node, ast.Call) and (
            called == "warn" or called.endswith(".warned")
        ):
            found += [(path.name, constants(text)) for text in node.args[:1]]
        elif isinstance(node, ast.Yield) and path.name in YIELDED:
            assert node.value is not None
            found.append((path.name, constants(node.value)))
    trust = LIBRARY / "inference" / "refinement" / "trust.py"
    for node in ast.walk(ast.parse(trust.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Tuple) and len(node.elts) == 3:  # holds, figure, text
            found.append((trust.name, constants(node.elts[2])))
    return [(file, text) for file, text in found if " " in text]


def named() -> list[type]:
    """Return the classes of the library's own errors."""
    found = []
    for path, node in nodes():
        if isinstance(node, ast.ClassDef) and any(
            re.fullmatch("OSError|KeyboardInterrupt|(Value|Type|Runtime)Error", b)
            for b in map(ast.unparse, node.bases)
        ):
            parts = path.relative_to(ROOT).with_suffix("").parts
            found.append(getattr(importlib.import_module(".".join(parts)), node.name))
    return [c for c in found if c.__name__ != "OddError"]


@pytest.mark.parametrize(("file", "text"), given(), ids=lambda v: v[:40])
def test_every_warning_names_its_place(file, text):
    place = PLACE.search(explained(text))
    assert place, f"{file}: expected words of ANCHORS in {text!r}; add them there"
    assert place.group(1) in HEADINGS


def test_there_is_one_door():
    """Or a warning could leave without its place."""
    doors = {
        path.name
        for path, node in nodes()
        if isinstance(node, ast.Call) and ast.unparse(node.func) == "warnings.warn"
    }
    assert doors == {"messages.py"}


def test_headings_are_words_of_messages():
    classes = {error.__name__ for error in named()}
    places = {name: text for name, text in HEADINGS.items() if text not in classes}
    assert {*places} == {*ANCHORS.values()}
    assert [n for n, text in places.items() if ANCHORS.get(text) != n] == []


def test_every_phrase_is_said_somewhere():
    """A phrase whose message was reworded is found."""
    texts = [
        constants(ast.parse(p.read_text(encoding="utf-8")))
        for p in files()
        if p.name != "messages.py"
    ]
    everything = " ".join(" ".join(texts).split())
    assert [p for p in ANCHORS if p not in everything] == []


def test_warnings_as_python_shows_them():
    with warnings.catch_warnings(record=True) as noted:
        warnings.simplefilter("always")
        Trials([1.0, 2.0], torch.tensor([1.0, torch.inf]))
    (note,) = noted
    assert str(note.message).endswith("(see warnings.html#infinite)")
    assert note.filename == __file__


def test_warnings_as_a_belief_keeps_them():
    known = Diagnostics().warned("few effective draws; raise num_histories")
    again = known.warned("the best mode was found by one of 3 searches")
    assert [PLACE.findall(text) for text in again.warnings] == [
        ["few-draws"],
        ["one-search"],
    ]
    assert str(again).count(PAGE) == 2


@pytest.mark.parametrize("error", named(), ids=lambda c: c.__name__)
def test_every_error_with_a_name_says_its_place(error):
    assert issubclass(error, Explained)
    place = PLACE.search(str(error.__new__(error, "expected ...; got ...")))
    assert place is not None
    assert HEADINGS[place.group(1)] == error.__name__


def test_other_errors_say_what_was_expected():
    """Which is their place: the heading "expected"."""
    assert "### `expected`" in TEXT
    other = [
        f"{path.name}: {constants(node.exc)}"
        for path, node in nodes()
        if isinstance(node, ast.Raise)
        and isinstance(node.exc, ast.Call)
        and re.fullmatch("(Value|Type|Runtime)Error", ast.unparse(node.exc.func))
        and "expected" not in constants(node.exc)
    ]
    assert len(other) <= CAUGHT, other

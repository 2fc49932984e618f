"""Every warning and error of the library says its code, and each code is explained."""

import ast
import importlib
import json
import pickle
import re
import warnings
from functools import cache
from pathlib import Path

import pytest
import torch

from sbi_active import messages
from sbi_active.campaign.storage.codec import decode, encode
from sbi_active.criticism import Trials
from sbi_active.inference.beliefs.diagnostics import Diagnostics

ROOT = Path(__file__).parents[2]
LIBRARY = ROOT / "sbi_active"
#: What takes messages.
GATHERED = re.compile(r"warn|.*\.warned|(texts|warnings|defects|self\.notes)\.append")
#: What is yielded there is one sentence of a report each.
YIELDED = {"given.py"}


@cache
def nodes() -> list[tuple[Path, ast.AST]]:
    return [
        (path, node)
        for path in sorted(LIBRARY.rglob("*.py"))
        if "tasks" not in path.parts
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
    ]


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
    return found


def texts(path: Path, node: ast.AST) -> list[ast.expr]:
    """Return what a line of code says that becomes a message."""
    if isinstance(node, ast.Yield) and path.name in YIELDED and node.value:
        return [node.value]
    if isinstance(node, ast.Call):
        called = ast.unparse(node.func)
        return node.args if GATHERED.fullmatch(called) else []
    if isinstance(node, ast.Tuple) and path.name == "trust.py":
        return node.elts[2:3]  # holds, figure, text
    return []


def test_codes_are_those_of_the_registry():
    said = {
        node.value[:5]
        for path, node in nodes()
        if path.name != "messages.py"
        and isinstance(node, ast.Constant)
        and isinstance(node.value, str)
        and re.match(r"SA\d{3}\b", node.value)
    }
    doubts = importlib.import_module("sbi_active.inference.declared.diagnosing")
    said |= {text[:5] for text in doubts.texts().values()}
    for template in (LIBRARY / "criticism" / "report").glob("*.jinja"):
        said |= {*re.findall(r"SA\d{3}", template.read_text(encoding="utf-8"))}
    assert said == {*messages.explanations()}
    headings = re.findall("^### .*", (LIBRARY / "messages.md").read_text(), re.M)
    assert len(headings) == len(said)
    assert {code[:3] for code in said} == {*messages.CATEGORIES}


def test_there_is_one_door():
    """Or a warning could leave without its code."""
    doors = {
        path.name
        for path, node in nodes()
        if isinstance(node, ast.Call) and ast.unparse(node.func) == "warnings.warn"
    }
    assert doors == {"messages.py"}
    plain = [
        ast.unparse(text)
        for path, node in nodes()
        for text in texts(path, node)
        if isinstance(text, ast.Constant | ast.JoinedStr)
        and not re.match(r"f?.(SA\d{3}|\{\w+(\[0\])?\}) ", ast.unparse(text))
    ]
    assert plain == []


def test_warnings_as_python_shows_them():
    with warnings.catch_warnings(record=True) as noted:
        warnings.simplefilter("always")
        Trials([1.0, 2.0], torch.tensor([1.0, torch.inf]))
    (note,) = noted
    assert str(note.message).endswith(" (SA201)")
    assert note.filename == __file__
    assert isinstance(note.message, messages.TrialWarning)
    assert note.message.code == "SA201"
    with warnings.catch_warnings(record=True) as noted:
        warnings.simplefilter("always")
        warnings.filterwarnings("ignore", ".*SA201")
        Trials([1.0, 2.0], torch.tensor([1.0, torch.inf]))
    assert not noted


@pytest.mark.parametrize(
    "through",
    [
        lambda known: known,
        lambda known: pickle.loads(pickle.dumps(known)),
        lambda known: decode(encode(known, known={}), known={}),
        lambda known: Diagnostics(warnings=json.loads(json.dumps(known.warnings))),
    ],
    ids=["at once", "pickle", "campaign", "json"],
)
def test_warnings_as_a_belief_keeps_them(through):
    known = Diagnostics().warned("SA114 few; raise num_histories")
    known = through(known.warned("found by one (see warnings.html#one-search)", "odd"))
    assert [warning.code for warning in known.warnings] == ["SA114", "SA118", ""]
    assert known.warnings[0] == "few; raise num_histories (SA114)"
    assert str(known).count("(SA1") == 2


@pytest.mark.parametrize("error", named(), ids=lambda c: c.__name__)
def test_every_error_with_a_name_says_its_place(error):
    assert issubclass(error, messages.Explained)
    said = messages.Message(error.__new__(error, "expected ...; got ..."))
    assert said.code == error.code
    assert f"`{error.__name__}`" in messages.explanations()[said.code][1]

"""The public names: few, importable, and what was renamed still works."""

import importlib
import subprocess
import sys
from pathlib import Path

import pytest

import sbi_active
from sbi_active import renamed

PACKAGES = ["sbi_active", *(f"sbi_active.{name}" for name in sbi_active._PACKAGES)]


def former_names() -> list[tuple[str, str, str]]:
    """Return package, former name and where it is now."""
    return [(*old.rsplit(".", 1), new) for old, new in renamed.former().items()]


@pytest.mark.parametrize("package", PACKAGES)
def test_public_names_are_there(package):
    module = importlib.import_module(package)
    assert len({*module.__all__}) == len(module.__all__)
    for name in module.__all__:
        assert getattr(module, name) is not None
    assert {*module.__all__} <= {*dir(module)}


def test_public_names_are_few():
    """A user reads them all in a minute; 80 or so, and the top level's again."""
    assert len(sbi_active.__all__) <= 25
    names = [importlib.import_module(package).__all__ for package in PACKAGES[1:]]
    assert sum(map(len, names)) <= 78  # the start of a film among them


def test_only_packages_have_public_names():
    """What a module defines is public by its package, or not at all."""
    for package in PACKAGES[1:]:
        path = importlib.import_module(package).__file__
        for module in Path(path).parent.rglob("[!_]*.py"):
            rooms = ("criticism", "workers", "bank", "storage")  # to be emptied
            if not {*rooms} & {*module.parts}:
                assert "__all__" not in module.read_text(), module


def test_importing_it_imports_nothing_heavy():
    code = (
        "import sys, sbi_active; dir(sbi_active); "
        "print({*sys.modules} & {'torch', 'numpy', 'sbi', 'attr'})"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout == "set()\n", done.stderr


@pytest.mark.parametrize(("package", "old", "new"), former_names())
def test_former_names_warn_with_the_new_one(package, old, new):
    home, _, name = new.partition(":")
    text = f"{package}.{old} goes in the next version: use {home}.{name}"
    with pytest.warns(DeprecationWarning, match=text) as noted:
        value = getattr(importlib.import_module(package), old)
    assert noted[0].filename == __file__
    now = importlib.import_module(home)
    for part in name.split("."):
        now = getattr(now, part)
    assert value == now
    assert old not in getattr(importlib.import_module(package), "__all__", [])


def test_other_names_are_errors():
    with pytest.raises(AttributeError, match="no attribute 'campain'"):
        sbi_active.campain  # noqa: B018 # pyright: ignore

import shutil
import sys
from pathlib import Path

import pytest

from tests.cli.sled import SIMULATOR, made_at


@pytest.fixture(scope="session")
def made(tmp_path_factory):
    """A campaign with a trial that was told and one to come; made once."""
    named = ["--names=speed", "--units=m/s"]
    return made_at(tmp_path_factory, SIMULATOR, "0.3", more=named)


@pytest.fixture(autouse=True)
def _nothing_imported(monkeypatch):
    """Each test imports its own programs, and leaves the path as it was."""
    monkeypatch.setattr(sys, "path", [*sys.path])
    for name in ("sled", "odd", "tape", "mine", "line", "my_robot", "my_motor"):
        monkeypatch.delitem(sys.modules, name, raising=False)


@pytest.fixture
def camp(made, tmp_path):
    """A copy of it."""
    shutil.copytree(made, tmp_path, dirs_exist_ok=True)
    return Path("camp")

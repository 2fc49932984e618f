import shutil
import sys
from pathlib import Path

import pytest

from sbi_active.cli import main
from tests.cli.sled import INIT, SIMULATOR


@pytest.fixture(scope="session")
def made(tmp_path_factory):
    """A campaign with a trial that was told and one to come; made once."""
    place = tmp_path_factory.mktemp("sled")
    (place / "sled.py").write_text(SIMULATOR)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(place)
        patch.setenv("XDG_STATE_HOME", str(tmp_path_factory.getbasetemp() / "state"))
        patch.setattr(sys, "path", [*sys.path])
        patch.delitem(sys.modules, "sled", raising=False)
        assert main([*INIT, "sled.py:slide", "--names=speed", "--units=m/s"]) == 0
        assert main(["tell", "camp", "0.3", "--action", "1"]) == 0
        assert main(["ask", "camp"]) == 0
    return place


@pytest.fixture
def camp(made, tmp_path, monkeypatch):
    """A copy of it, of which nothing is imported yet."""
    shutil.copytree(made, tmp_path, dirs_exist_ok=True)
    monkeypatch.setattr(sys, "path", [*sys.path])
    for name in ("sled", "odd", "tape", "mine"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    return Path("camp")

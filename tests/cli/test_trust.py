"""What is executed, and when: nothing that somebody else put into a folder."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from sbi_active.cli import main
from tests.cli.sled import SIMULATOR, SMALL, run

ROOT = Path(__file__).parents[2]

#: A prior and actions that only a program can make, beside its simulator.
MINE = (
    SIMULATOR
    + """
from pathlib import Path
from torch.distributions import Independent, Uniform
from sbi_active import DiscreteActions

{run}


class Mine(Independent):
    pass


class Speeds(DiscreteActions):
    pass


prior = Mine(Uniform(torch.tensor([0.2, 0.0]), torch.ones(2)), 1)
actions = Speeds([1.0, 2.0], names=["speed"], units=["m/s"])
"""
)
RUN = "Path('{}').write_text('ran')"
READING = [
    ["status", "camp", "--json"],
    ["tell", "camp", "0.3", "--action", "1"],
    ["correct", "camp", "0", "0.31"],
    ["withdraw", "camp", "0"],
    ["report", "camp"],
]
NAMED = ["--simulator", "mine.py:slide"]


@pytest.fixture
def mine(tmp_path, request):
    """A campaign whose simulator, prior and actions are programs, or only the first."""
    ran = tmp_path / "ran"
    forget(ran)
    program = MINE.format(run=RUN.format(ran))
    if getattr(request, "param", None) == "stored":
        program = program.replace("= Mine(", "= Independent(")
        program = program.replace("= Speeds(", "= DiscreteActions(")
    (tmp_path / "mine.py").write_text(program)
    assert main(["init", "camp", *NAMED, *SMALL]) == 0
    main(["tell", "camp", "0.3", "--action", "1"])
    forget(ran)
    return ran


def forget(ran):
    """Have the next import run again."""
    sys.modules.pop("mine", None)
    ran.unlink(missing_ok=True)


@pytest.mark.parametrize("mine", ["stored"], indirect=True)
@pytest.mark.parametrize("words", READING, ids=lambda w: w[0])
def test_reading_imports_nothing(mine, words):
    assert main(words) == 0
    assert not mine.exists()
    assert "mine" not in sys.modules


def test_a_module_is_looked_for_where_it_was_named(mine, tmp_path, monkeypatch):
    assert main(["init", "new", "--simulator", "mine:slide", *SMALL]) == 0
    forget(mine)
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "mine.py").write_text("raise SystemExit('another one')")
    monkeypatch.chdir("other")
    assert main(["ask", str(tmp_path / "new"), "--target", "weather"]) == 2
    assert mine.exists()


@pytest.mark.parametrize("command", ["ask", "update", "criticize", "adopt"])
def test_nothing_that_a_folder_says_is_imported(mine, tmp_path, capsys, command):
    Path("camp").rename("other")  # as one that was sent
    says = {"folder": str(tmp_path), "simulator": "mine.py:slide"}
    Path("other/command.json").write_text(json.dumps(says))  # of earlier versions
    assert main([command, "other"]) == 2
    assert "expected --simulator; got none" in capsys.readouterr().err
    assert not mine.exists()
    assert main(["report", "other"]) == 2  # whose prior only a program can make
    assert not mine.exists()


def test_named_once_it_is_known_again(mine):
    Path("camp").rename("other")
    words = ["export", "other", "--netcdf", "out.nc"]
    assert main([*words, *NAMED, "--noise", "0.02"]) == 0
    assert mine.exists()
    forget(mine)
    assert main(["ask", "other", "--target", "weather"]) == 2
    assert mine.exists()


def test_a_home_that_cannot_be_written_remembers_nothing(mine, capsys, monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", "/dev/null")
    assert main(["init", "new", *NAMED, *SMALL]) == 0
    assert main(["ask", "new"]) == 2
    assert "expected --simulator; got none" in capsys.readouterr().err


@pytest.mark.parametrize("mine", ["stored"], indirect=True)
def test_what_stands_beside_somebody_is_not_imported(mine, tmp_path):
    """A file called as a library, in a folder that somebody has just entered."""
    for name in ("torch", "sqlite3", "mine"):
        text = f"from pathlib import Path\n{RUN.format(tmp_path / 'stood')}"
        (tmp_path / "camp" / f"{name}.py").write_text(text)
    words, env = ["status", "."], {"PYTHONPATH": str(ROOT)}
    pipes = {"stdout": subprocess.DEVNULL, "cwd": tmp_path / "camp"}
    process = run(words, env=env, **pipes)
    assert process.wait() == 0, process.stderr.read()
    assert not (tmp_path / "stood").exists()
    assert not mine.exists()

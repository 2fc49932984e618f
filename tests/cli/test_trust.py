"""What of a folder is executed, and when: nothing that somebody else put there."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from sbi_active.cli import main
from tests.cli.test_campaign import SIMULATOR

#: A prior and actions that only a program can make.
MINE = """
import torch
from pathlib import Path
from torch.distributions import Independent, Uniform
from sbi_active import DiscreteActions

{run}


class Mine(Independent):
    pass


class Speeds(DiscreteActions):
    pass


prior = Mine(Uniform(torch.tensor([0.2, 0.0]), torch.ones(2)), 1)
speeds = Speeds([1.0, 2.0], names=["speed"], units=["m/s"])
"""
RUN = "Path('{}').write_text('ran')"
SIZES = ["--noise", "0.02", "--num-simulations", "200", "--method", "nsbi"]
READING = [
    ["status", "camp", "--json"],
    ["tell", "camp", "0.3", "--action", "1"],
    ["correct", "camp", "0", "0.31"],
    ["withdraw", "camp", "0"],
    ["report", "camp"],
    ["watch", "camp", "--once", "page.html"],
    ["repair", "camp"],
]
SIMULATING = [
    ["ask", "camp"],
    ["update", "camp"],
    ["criticize", "camp"],
    ["adopt", "camp"],
]


@pytest.fixture
def mine(tmp_path, monkeypatch):
    """A campaign with a simulator, a prior and actions of one file."""
    monkeypatch.setattr(sys, "path", [*sys.path])
    for name in ("sled", "mine"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    ran = tmp_path / "ran"
    (tmp_path / "sled.py").write_text(SIMULATOR)
    (tmp_path / "mine.py").write_text(MINE.format(run=RUN.format(ran)))
    words = ["--simulator", "sled.py:slide", "--prior", "mine.py:prior"]
    assert main(["init", "camp", *words, "--actions", "mine.py:speeds", *SIZES]) == 0
    main(["tell", "camp", "0.3", "--action", "1"])
    forget(ran)
    return ran


def forget(ran):
    """Have the next import of these run again."""
    for name in ("sled", "mine"):
        sys.modules.pop(name, None)
    ran.unlink(missing_ok=True)


@pytest.mark.parametrize("words", READING, ids=lambda w: w[0])
def test_reading_imports_nothing(mine, words):
    assert main(words) == 0
    assert not mine.exists()
    assert not {"sled", "mine"} & {*sys.modules}


def test_what_is_read_of_a_prior_that_is_a_program(mine, capsys):
    capsys.readouterr()
    assert main(["status", "camp", "--json"]) == 0
    (first, second) = json.loads(capsys.readouterr().out)["belief"][
        "parameters"
    ].values()
    assert first == {
        "mean": pytest.approx(0.6),
        "sd": pytest.approx(0.8 / 12**0.5),
    }
    assert second["mean"] == pytest.approx(0.5)
    assert main(["update", "camp"]) == 0  # the owner's own needs no word
    capsys.readouterr()
    forget(mine)
    assert main(["status", "camp", "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["not_in_belief"] == []
    assert answer["trials"][0]["names"] == ["speed"]
    assert answer["belief"]["parameters"]["theta_1"]["sd"] < 0.8 / 12**0.5
    assert main(["export", "camp", "--netcdf", "out.nc"]) == 2  # no density of draws
    assert not mine.exists()


@pytest.mark.parametrize("words", SIMULATING, ids=lambda w: w[0])
@pytest.mark.parametrize("how", ["changed", "of another account", "within"])
def test_what_somebody_else_declared_is_not_imported(
    mine, tmp_path, monkeypatch, capsys, words, how
):
    path = tmp_path / "camp" / "command.json"
    declared = json.loads(path.read_text())
    if how == "changed":
        path.write_text(json.dumps(declared))  # one byte is enough
    elif how == "of another account":
        monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "other"))
    else:
        shutil.copy("mine.py", "camp/mine.py")
        path.write_text(json.dumps({**declared, "folder": str(tmp_path / "camp")}))
    assert main(words) == 2
    assert "add --trust to have it executed" in capsys.readouterr().err
    assert not mine.exists()
    assert main(["status", "camp"]) == 0
    assert not mine.exists()


def test_trust_is_remembered_outside_of_the_folder(mine, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "other"))
    assert main(["update", "camp"]) == 2
    assert main(["update", "camp", "--trust"]) == 0
    assert mine.exists()
    forget(mine)
    assert main(["update", "camp"]) == 0
    assert mine.exists()


def test_within_the_folder_trust_is_said_each_time(mine, tmp_path, capsys):
    shutil.copy("mine.py", "camp/mine.py")
    shutil.copy("sled.py", "camp/sled.py")
    path = tmp_path / "camp" / "command.json"
    declared = json.loads(path.read_text())
    path.write_text(json.dumps({**declared, "folder": str(tmp_path / "camp")}))
    assert main(["update", "camp", "--trust"]) == 0
    assert mine.exists()
    forget(mine)
    assert main(["update", "camp"]) == 2
    assert not mine.exists()


def test_a_simulator_of_the_command_line_needs_no_word(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.delitem(sys.modules, "sled", raising=False)
    (tmp_path / "sled.py").write_text(SIMULATOR)
    bounds = ["--theta-low", "0.2,0", "--theta-high", "1,1", "--actions", "1,2"]
    assert main(["init", "camp", "--simulator", "sled.py:slide", *bounds, *SIZES]) == 0
    (tmp_path / "camp" / "command.json").unlink()
    assert main(["ask", "camp"]) == 2
    assert "name it, as in --simulator" in capsys.readouterr().err
    words = ["--simulator", "sled.py:slide"]
    main(["tell", "camp", "0.3", "--action", "1"])
    del sys.modules["sled"]
    # Its noise was in the file, so that it is another one, and told to be.
    assert main(["update", "camp", *words]) == 2
    assert "simulator_changed=True" in capsys.readouterr().err


@pytest.mark.parametrize(
    "content",
    ["", "[]", "{", '{"simulator": 3}', '{"effects": [1]}', "[" * 9999],
)
def test_a_file_that_the_command_line_did_not_write(mine, capsys, content):
    Path("camp/command.json").write_text(content)
    for words in (["status", "camp"], ["ask", "camp"]):
        assert main(words) == 2
        assert "command.json as sbi-active writes it" in capsys.readouterr().err


def test_what_stands_beside_somebody_is_not_imported(mine, tmp_path):
    """A file called as a library, in a folder that somebody has just entered."""
    for name in ("torch", "sqlite3", "sled"):
        text = f"from pathlib import Path\n{RUN.format(tmp_path / 'stood')}"
        (tmp_path / "camp" / f"{name}.py").write_text(text)
    for words in (
        ["status", "."],
        ["tell", ".", "0.3", "--action", "1"],
        ["report", "."],
    ):
        done = subprocess.run(
            [
                sys.executable,
                "-c",
                "from sbi_active.cli import main; exit(main())",
                *words,
            ],
            cwd=tmp_path / "camp",
            env={**os.environ, "PYTHONPATH": ""},
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, done.stderr
    assert not (tmp_path / "stood").exists()
    assert not mine.exists()

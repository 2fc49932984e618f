"""What of a folder is executed, and when: nothing that somebody else put there."""

import json
import shutil
import sys
from pathlib import Path

import pytest

from sbi_active.cli import main
from tests.cli.sled import SIMULATOR, SMALL, run

ROOT = Path(__file__).parents[2]

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
IMPORTING = "\nfrom pathlib import Path\n", "\n"
READING = [
    ["status", "camp", "--json"],
    ["tell", "camp", "0.3", "--action", "1"],
    ["correct", "camp", "0", "0.31"],
    ["withdraw", "camp", "0"],
]


@pytest.fixture
def mine(tmp_path, monkeypatch, request):
    """A campaign whose simulator, prior and actions are programs, or only the first."""
    monkeypatch.setattr(sys, "path", [*sys.path])
    ran = tmp_path / "ran"
    forget(ran)
    (tmp_path / "sled.py").write_text(SIMULATOR)
    (tmp_path / "mine.py").write_text(MINE.format(run=RUN.format(ran)))
    own = ["--prior", "mine.py:prior", "--actions", "mine.py:speeds"]
    if getattr(request, "param", None) == "stored":
        own = ["--theta-low=0.2,0", "--theta-high=1,1", "--actions", "0.5:3"]
        (tmp_path / "sled.py").write_text(SIMULATOR + RUN.format(ran).join(IMPORTING))
    words = ["--simulator", "sled.py:slide", *own]
    assert main(["init", "camp", *words, *SMALL]) == 0
    main(["tell", "camp", "0.3", "--action", "1"])
    forget(ran)
    return ran


def forget(ran):
    """Have the next import of these run again."""
    for name in ("sled", "mine"):
        sys.modules.pop(name, None)
    ran.unlink(missing_ok=True)


@pytest.mark.parametrize("mine", ["stored"], indirect=True)
@pytest.mark.parametrize("words", READING, ids=lambda w: w[0])
def test_reading_imports_nothing(mine, words):
    assert main(words) == 0
    assert not mine.exists()
    assert not {"sled", "mine"} & {*sys.modules}


@pytest.mark.parametrize(
    ("how", "command"),
    [
        ("changed", "ask"),
        ("changed", "criticize"),
        ("of another account", "ask"),
        ("within", "ask"),
    ],
)
def test_what_somebody_else_declared_is_not_imported(
    mine, tmp_path, monkeypatch, capsys, command, how
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
    assert main([command, "camp"]) == 2
    assert "add --trust to have it executed" in capsys.readouterr().err
    assert not mine.exists()
    assert main(["status", "camp"]) == 0
    assert not mine.exists()
    assert main(["report", "camp"]) == 2  # whose prior only a program can make
    assert not mine.exists()


def test_trust_is_remembered_outside_of_the_folder(mine, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "other"))
    assert main(["export", "camp", "--netcdf", "out.nc", "--trust"]) == 0
    assert mine.exists()
    forget(mine)
    assert main(["ask", "camp", "--target", "weather"]) == 2  # but it is imported
    assert mine.exists()
    # Within the folder it is said each time.
    forget(mine)
    for name in ("mine.py", "sled.py"):
        shutil.copy(name, "camp")
    path = tmp_path / "camp" / "command.json"
    declared = json.loads(path.read_text())
    path.write_text(json.dumps({**declared, "folder": str(tmp_path / "camp")}))
    assert main(["export", "camp", "--netcdf", "out.nc", "--trust"]) == 0
    forget(mine)
    assert main(["ask", "camp"]) == 2
    assert not mine.exists()


@pytest.mark.parametrize(
    "content", ["", "[]", '{"simulator": 3}', '{"effects": [1]}', "[" * 9999]
)
def test_a_file_that_the_command_line_did_not_write(mine, capsys, content):
    Path("camp/command.json").write_text(content)
    assert main(["ask", "camp"]) == 2
    assert "command.json as sbi-active writes it" in capsys.readouterr().err
    assert main(["status", "camp"]) == 0  # which needs none of it


@pytest.mark.parametrize("mine", ["stored"], indirect=True)
def test_what_stands_beside_somebody_is_not_imported(mine, tmp_path):
    """A file called as a library, in a folder that somebody has just entered."""
    for name in ("torch", "sqlite3", "sled"):
        text = f"from pathlib import Path\n{RUN.format(tmp_path / 'stood')}"
        (tmp_path / "camp" / f"{name}.py").write_text(text)
    for words in (["status", "."], ["report", "."]):
        process = run(words, cwd=tmp_path / "camp", env={"PYTHONPATH": str(ROOT)})
        assert process.wait() == 0, process.stderr.read()
    assert not (tmp_path / "stood").exists()
    assert not mine.exists()

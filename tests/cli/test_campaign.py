"""A campaign driven from the command line, as a robot's program would."""

import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import arviz as az
import pandas as pd
import pytest
from matplotlib import image

from sbi_active.cli import main, problem
from tests.cli.sled import SIZES, SMALL, read


def answer(capsys, *words):
    """Return what a command prints as JSON."""
    capsys.readouterr()
    assert main([*words, "--json"]) == 0
    return read(capsys.readouterr().out)


def test_asked_told_believed_and_exported(camp, capsys):
    named = ["--simulator", "sled.py:slide", "--noise", "0.02"]  # of a copy
    asked = answer(capsys, "ask", "camp", *named)
    assert asked["trial"] == 1
    assert asked["names"] == ["speed"]
    assert 0.5 <= asked["action"][0] <= 3
    assert answer(capsys, "ask", "camp")["action"] == asked["action"]
    before = answer(capsys, "status", "camp")["belief"]["parameters"]["theta_1"]["sd"]
    assert answer(capsys, "tell", "camp", "0.7")["x"] == [pytest.approx(0.7)]
    assert answer(capsys, "status", "camp")["not_in_belief"] == [1]
    after = answer(capsys, "update", "camp")
    assert after["not_in_belief"] == []
    assert after["belief"]["parameters"].keys() == {"theta_1", "theta_2"}
    assert after["belief"]["parameters"]["theta_1"]["sd"] < before
    assert main(["export", "camp", "--netcdf", "out.nc"]) == 0
    assert az.from_netcdf("out.nc")["posterior"]["theta"].shape == (4, 500, 2)


TAPE = """
from torch.distributions import Normal
from sbi_active.criticism import Effect

offset = Effect(
    "tape slipped",
    hook="observation",
    prior=Normal(0.0, 1.0),
    null=0.0,
    apply=lambda x, phi, action, context: x + phi,
)
own = [offset]
"""
LINE = """
from tape import own as effects


def line(theta, action):
    return theta * action
"""


def test_a_missing_effect_is_found_and_adopted(
    capsys, monkeypatch, tmp_path, few_draws
):
    monkeypatch.setattr(problem, "generic_effects", lambda *_, **__: [])
    Path("line.py").write_text(LINE)
    Path("tape.py").write_text(TAPE)
    words = ["--simulator", "line.py:line", "--theta-low", "0", "--theta-high", "1"]
    assert main(["init", "camp", *words, "--actions", "1,2,3", *SMALL]) == 0
    for index, action in enumerate((1, 2, 3, 1)):
        x = f"{0.5 * action + 0.3 + 0.02 * (-1) ** index:.4f}"
        assert main(["tell", "camp", x, "--action", str(action)]) == 0
    assert main(["criticize", "camp"]) == 0
    shown = capsys.readouterr().out
    assert "Verdict: tape slipped" in shown
    assert "sbi-active adopt camp" in shown
    assert main(["adopt", "camp"]) == 0
    monkeypatch.chdir(tmp_path.parent)  # where line.py lies is remembered
    folder = str(tmp_path / "camp")
    assert main(["update", folder]) == 0
    belief = answer(capsys, "status", folder)["belief"]["parameters"]
    assert belief["theta_2"]["mean"] == pytest.approx(0.3, abs=0.06)
    assert main(["report", folder]) == 0
    page = (tmp_path / "camp" / "report.html").read_text()
    assert "tape slipped" in page
    assert "http" not in page.replace("http-equiv", "")


def test_the_next_command_can_be_pasted(camp, capsys):
    Path("camp").rename("the sled")
    assert main(["tell", "the sled", "0.7", "--action", "1"]) == 0
    assert "next: sbi-active ask 'the sled'" in capsys.readouterr().out


def test_python_has_the_command_line():
    command = [sys.executable, "-m", "sbi_active", "--version"]
    shown = subprocess.run(command, capture_output=True, text=True, check=True)
    assert shown.stdout.strip() == version("sbi-active")


# A task's campaign


def test_run_writes_table_and_figure(capsys):
    words = ["run", "numerical", "--rounds", "2", "--out", "a"]
    words += [f"--set={size}" for size in (*SIZES, "num_samples=100")]
    assert main(words) == 0
    printed = capsys.readouterr().out
    assert "the truth: " in printed
    assert "a/loop.png" in printed
    assert len(pd.read_csv("a/trials.csv")) == 2
    assert "sbi-active ask a/campaign" in printed
    assert image.imread("a/loop.png").shape[1] == 1320  # of campaign.plot

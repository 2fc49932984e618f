"""What somebody means by a number, a file, an action, and what is none."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from sbi_active import Campaign
from sbi_active.cli import main

SLED = (
    "def slide(theta, action):\n    print('noise')\n    return theta[:, :1] * action\n"
)


@pytest.fixture
def camp(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    for name in ("sled", "torch_prior"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    Path("sled.py").write_text(SLED)
    bounds = ["--theta-low", "0.2,-1", "--theta-high", "1,1"]
    sizes = ["--num-simulations", "200", "--num-samples", "50", "--method", "nsbi"]
    words = ["--simulator", "sled.py:slide", "--actions", "-2:2", "--noise", ".1"]
    assert main(["init", "camp", *words, *bounds, *sizes]) == 0
    return Path("camp")


def history():
    return [(t.status, t.action.tolist(), t.x) for t in Campaign.load("camp").history]


@pytest.mark.parametrize("text", ["-1e-3", "-.5e2", "-2", "-3.", "-0.25"])
def test_numbers_may_begin_with_a_minus(camp, text):
    assert main(["tell", "camp", text, "--action", "-1e-1"]) == 0
    ((status, action, x),) = history()
    assert status == "ok"
    assert action == pytest.approx([-0.1])
    assert x.tolist() == pytest.approx([float(text)])


@pytest.mark.parametrize("text", ["", " ", "inf", "1e39", "nan", "0.84 m", "O"])
def test_what_is_no_number_becomes_no_outcome(camp, text, capsys):
    assert main(["tell", "camp", text, "--action", "1"]) == 2
    assert "expected" in capsys.readouterr().err
    assert history() == []
    assert main(["tell", "camp", "--invalid", "--action", "1"]) == 0
    assert history()[0][0] == "invalid"


@pytest.mark.parametrize(
    ("content", "value"),
    [
        (b"\xef\xbb\xbf0.84\n", 0.84),
        (b"x_height\n0.84\n", 0.84),
        (b"0.84 m\n", None),
        (b"0.84;1\n", None),
        (b"0,84\n", None),
        (b"", None),
        (b"\n\n", None),
        (b"height\n", None),
    ],
)
def test_a_file_is_read_or_the_old_number_stays(camp, content, value):
    assert main(["tell", "camp", "0.5", "--action", "1"]) == 0
    Path("x.csv").write_bytes(content)
    words = ["correct", "camp", "0", "--file", "x.csv", "--reason", "typo"]
    assert main(words) == (2 if value is None else 0)
    expected = 0.5 if value is None else value
    assert float(history()[0][2]) == pytest.approx(expected)


def test_a_correction_says_something(camp):
    main(["tell", "camp", "0.5", "--action", "1"])
    assert main(["correct", "camp", "0", "--reason", "typo"]) == 2
    assert main(["correct", "camp", "0", "--action", "-1.5"]) == 0
    assert history()[0][1] == [-1.5]


def test_json_alone_is_printed_whatever_the_simulator_prints(camp, capsys):
    def refuse(text):
        raise AssertionError(text)

    capsys.readouterr()
    for words in (["ask"], ["tell", "0.5"], ["update"], ["status"]):
        assert main([words[0], "camp", *words[1:], "--json"]) == 0
        printed = capsys.readouterr()
        json.loads(printed.out, parse_constant=refuse)
        assert "noise" not in printed.out


def test_options_of_tables_are_not_ignored_for_a_campaign(camp, capsys):
    for words in (["--noise", "0.1"], ["--theta-low", "0"], ["--units", "x=m"]):
        assert main(["criticize", "camp", *words]) == 2
        assert "for a campaign" in capsys.readouterr().err
    assert main(["criticize", "camp", "--effects", "no_such_module:NAME"]) == 2
    assert "no_such_module" in capsys.readouterr().err


@pytest.mark.parametrize("spec", [["1:2:1000000000"], ["0:1:1000", "0:1:1000"]])
def test_a_list_of_actions_is_bounded(camp, spec, capsys):
    words = ["--theta-low", "0", "--theta-high", "1", "--actions", *spec]
    assert main(["init", "other", "--simulator", "sled.py:slide", *words]) == 2
    assert "expected at most 100000" in capsys.readouterr().err


def test_an_interrupt_is_one_line(camp, monkeypatch, capsys):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("sbi_active.cli.campaign.open_campaign", interrupted)
    assert main(["ask", "camp"]) == 130
    assert "interrupted" in capsys.readouterr().err


def test_a_reader_that_leaves_is_no_error(camp):
    script = "import sys; from sbi_active.cli import main; sys.exit(main(sys.argv[1:]))"
    process = subprocess.Popen(
        [sys.executable, "-O", "-c", script, "status", "camp"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env={"LC_ALL": "C", "PATH": ""},
    )
    assert process.stdout is not None
    assert process.stderr is not None
    process.stdout.close()
    text = process.stderr.read()
    process.wait()
    assert b"Traceback" not in text

"""Odd calls: each is right or a clear error, and what a program reads is JSON."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from sbi_active import Campaign, __version__
from sbi_active.campaign.learning import methods
from sbi_active.cli import declare, main
from sbi_active.cli.problem import load_module
from tests.cli.sled import BOX, INIT, SIMULATOR, SMALL, forget, forked, read, run

ODD = """
NUMBER = 3.0
prior = 3.0


def broken(theta, action):
    raise ZeroDivisionError("by zero")


def stopped(theta, action):
    raise KeyboardInterrupt


def short(theta, action):
    return theta[:1, :1]


"""
FILES = {
    "odd.py": ODD.encode(),
    "divides.py": b"1 / 0",
    "bom.csv": b"\xef\xbb\xbf0.84\n",
    "named.csv": b"x_height\n0.84\n",
    "unit.csv": b"0.84 m\n",
    "semicolon.csv": b"0,84;1\n",
    "empty.csv": b"",
    "nul.csv": b"0.8\x004\n",
    "nan.csv": b"x\nnan\n",
    "two.csv": b"0.1,0.2\n",
}
OF = ["init", "new", *BOX, *SMALL, "--simulator"]
SLED, ASK = [*OF, "sled.py:slide"], ["--actions", "1,2"]

#: What has to be told apart by its exit status, and a part of the error's text.
CALLS = [
    # Numbers.
    (0, "", "tell camp 1e-20 --json"),
    *(
        (2, "expected", ["tell", "camp", x])
        for x in ("", "inf", "1e-50", "0,84", "1_000", "0.84 m")
    ),
    *((2, "expected", ["tell", "camp", "1", "--action", a]) for a in ("inf", "1,2")),
    (2, "expected the index of", "tell camp 1 --trial 99 --action 1"),
    (2, "got several; write one", "tell camp 1 --file bom.csv"),
    (0, "", ["withdraw", "camp", "0", "--reason", "\n\x1b[31m", "--json"]),
    # Files.
    (0, "", "correct camp 0 --file bom.csv"),
    *(
        (2, "expected", f"correct camp 0 --file {name}")
        for name in FILES
        if name.endswith("csv") and name != "bom.csv"
    ),
    (2, "No such file", "tell camp --file none.csv"),
    # Folders.
    (2, "expected a campaign; got no", "ask nowhere"),
    (2, "", ["status", "a\0b"]),
    (2, "choose another folder", [*INIT, "sled.py:slide"]),
    (2, "No such file", "report camp --out no/such/folder/page.html"),
    (2, "expected --simulator", "criticize bom.csv"),
    # A campaign has its own of these.
    (2, "for a campaign", "criticize camp --theta-low 0.1"),
    (2, "Not a directory", "criticize camp --out bom.csv/report"),  # said at once
    # Spaces.
    *(
        (2, "at most 100000 actions", [*SLED, "--actions", spec])
        for spec in ("1:2:1000000000", "1:2:", "1:2:3:4", "1:2:-3")
    ),
    (0, "", [*SLED, "--actions", "-1:1", "--actions", "-5:-4"]),
    (2, "LOW:HIGH:COUNT", [*SLED, "--actions", "-1:1", "--actions", "1,2"]),
    *(
        (2, text, [*SLED, *ASK, *words.split()])
        for text, words in (
            ("expected finite", "--noise nan"),
            ("expected --noise > 0", "--noise -1"),
            ("--theta-low below --theta-high", "--theta-low 1,1"),
            ("expected num_workers", "--set workers.num_workers=0"),
        )
    ),
    (2, "Distribution; got float", [*OF[:2], "--simulator", "odd.py:short", *ASK]),
    (2, "as in --simulator my_robot.py:fn", ["init", "new", *BOX]),
    # Programs.
    *(
        (2, text, [*OF, name, *ASK])
        for text, name in (
            ("expected MODULE:NAME", "sled"),
            ("add its name behind a colon", "sled.py"),
            ("expected a file; got none at", "torch.py:nn"),
            ("a name in sled; got 'none'", "sled.py:none"),
            ("expected a function", "odd.py:NUMBER"),
            ("got ZeroDivisionError", "divides.py:f"),
            ("one row a parameter set", "odd.py:short"),
        )
    ),
    (1, "by zero", [*OF, "odd.py:broken", *ASK]),
    (130, "interrupted", [*OF, "odd.py:stopped", *ASK]),
    *(
        (2, text, f"run {words}")
        for text, words in (
            ("expected what 'numerical' needs", "numerical --out o --option target=2"),
            ("expected a task among 'numerical'", "numerica --out d"),
            ("expected keywords of", "numerical --out d --set sized=3"),
            ("expected NAME=VALUE; got 'seed'", "numerical --out d --set seed"),
        )
    ),
]


@pytest.fixture
def files(camp):
    for name, content in FILES.items():
        Path(name).write_bytes(content)
    return camp


@pytest.mark.parametrize(("status", "text", "words"), CALLS, ids=lambda w: str(w)[:60])
def test_an_odd_call(files, capfd, status, text, words):
    assert main(words.split() if isinstance(words, str) else words) == status
    shown = capfd.readouterr()
    if status:
        assert "sbi-active" in shown.err or "defect" in shown.out
        assert text in shown.err
        assert "Traceback" not in shown.err
    elif "--json" in words:
        read(shown.out)


def test_numbers_may_begin_with_a_minus(files):
    words = ["--actions", "-2:2", "--simulator", "sled.py:slide"]
    assert main(["init", "new", *BOX, *SMALL, *words]) == 0
    assert main(["tell", "new", "-.5e2", "--action", "-1e-1"]) == 0
    (trial,) = Campaign.load("new").history
    assert trial.action.tolist() == pytest.approx([-0.1])
    assert trial.x.tolist() == [-50.0]


def test_numbers_that_are_not_finite_are_null(camp, capfd, monkeypatch):
    mean, variance = torch.tensor([[torch.nan, 1.0], [torch.inf, 4.0]])
    infinite = SimpleNamespace(mean=mean, variance=variance)
    monkeypatch.setattr(Campaign, "belief", infinite)
    monkeypatch.setattr(Campaign, "parameter_names", ["a", "b"])
    forget(Path("camp"))  # what was summed up with another belief
    assert main(["status", "camp", "--json"]) == 0
    known = read(capfd.readouterr().out)["belief"]["parameters"]
    assert known == {"a": {"mean": None, "sd": None}, "b": {"mean": 1.0, "sd": 2.0}}


@pytest.mark.parametrize("how", ["head", "full"])
def test_an_output_that_takes_no_more(camp, how):
    if how == "head":
        ours, theirs = os.pipe()
        os.close(ours)
    else:
        theirs = os.open("/dev/full", os.O_WRONLY)
    process = run(["status", "camp"], stdout=theirs)
    os.close(theirs)
    _, error = process.communicate()
    assert process.returncode == (1 if how == "head" else 2)
    assert "Traceback" not in error
    assert "Exception ignored" not in error
    assert ("No space left" in error) == (how == "full")


def test_a_locale_that_is_not_utf8(camp):
    words = [*SLED, *ASK, "--units", "µm", "--names", "größe"]
    words = [word.encode().decode("ascii", "surrogateescape") for word in words]
    process = forked(words, place="C", stdout=subprocess.PIPE)
    error = process.communicate()[1]
    assert process.returncode == 0, error
    assert main(["tell", "new", "0.3", "--action", "1"]) == 0
    env = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONIOENCODING": ""}
    words = ["correct", "new", "0", "0.4", "--reason", "µ", "--json"]
    shown, error = run(words, stdout=subprocess.PIPE, env=env).communicate()
    answer = read(shown)
    assert (answer["names"], answer["units"]) == (["größe"], ["µm"])
    assert answer["reason"] == "µ"


def test_interrupted_while_it_simulates():
    slow = "\nimport time\n\n\ndef slow(theta, action):\n    open('on', 'w')\n"
    Path("slow.py").write_text(SIMULATOR + slow + "    time.sleep(60)\n")
    process = forked(["check", "slow.py:slow", *BOX, *ASK], stdout=subprocess.PIPE)
    for _ in range(600):
        if Path("on").exists():
            break
        time.sleep(0.1)
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=120)
    assert process.returncode == 130
    assert "Traceback" not in error


def test_a_module_of_the_current_folder_comes_first(tmp_path, monkeypatch):
    (tmp_path / "tabnanny.py").write_text("NUMBER = 3\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path, str(tmp_path)])
    monkeypatch.delitem(sys.modules, "tabnanny", raising=False)
    assert load_module("tabnanny:NUMBER")[0].NUMBER == 3


# Help, the version, slips of the pen and completion, before torch is imported


#: Exit status, and which of what takes seconds to import has been imported.
COMMAND = """
import sys
from sbi_active.cli import main
try:
    sys.exit(main())
finally:
    heavy = {"torch", "numpy", "scipy", "sbi", "matplotlib", "pandas", "arviz"}
    print("imported:", sorted(heavy & {*sys.modules}))
"""


#: Words, exit status, and a part of what is shown.
QUICK = [
    (["--help"], 0, "Find what a simulator lacks"),
    (["run", "-h"], 0, "[asbi|nsbi|alhi|nlhi|seqbed]"),
    (["--version"], 0, __version__),
    (["biuld"], 2, "No such command 'biuld'"),
    (["run", "numerical", "--roundz", "3", "--out", "d"], 2, "option '--roundz'"),
]


@pytest.mark.parametrize(("arguments", "status", "text"), QUICK)
def test_nothing_heavy_is_imported(arguments, status, text):
    words = [sys.executable, "-c", COMMAND, *arguments]
    done = subprocess.run(words, capture_output=True, text=True)
    assert done.returncode == status
    assert text in " ".join((done.stdout + done.stderr).split())
    assert done.stdout.endswith("imported: []\n")


#: Words, the kind of error, and a part of its text.
SLIPS = [
    ("fly camp", "NoSuchCommand", "No such command 'fly'"),
    ("status nowhere", "ValueError", "expected a campaign; got no nowhere"),
    ("status \ud800", "UnicodeEncodeError", "surrogates not allowed"),
]


@pytest.mark.parametrize(("line", "kind", "text"), SLIPS)
def test_a_slip_is_json_as_well(line, kind, text, capfd):
    assert main([*line.split(), "--json"]) == 2
    shown = capfd.readouterr()
    error = read(shown.out)["error"]
    assert (error["type"], error["status"]) == (kind, 2)
    assert text in error["message"]
    assert shown.err.startswith("sbi-active: ")


def test_names_are_those_of_the_library():
    assert (*methods.METHODS,) == declare.METHODS


@pytest.mark.parametrize(
    ("line", "offered"),
    [("sbi-active st", "status"), ("sbi-active init camp --method nl", "nlhi")],
)
def test_a_shell_completes(line, offered):
    env = {"_SBI_ACTIVE_COMPLETE": "bash_complete", "COMP_WORDS": line}
    env["COMP_CWORD"] = str(line.count(" "))
    shown, _ = run([], env=env, stdout=subprocess.PIPE).communicate()
    assert [row.partition(",")[2] for row in shown.splitlines()] == [offered]

"""Odd calls: each is right or a clear error, and what a program reads is JSON."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from sbi_active import Campaign, CampaignOptions
from sbi_active.campaign.options import CampaignDetails
from sbi_active.cli import campaign as commands
from sbi_active.cli import main
from tests.campaign.sizes import REFINEMENT
from tests.cli.test_campaign import SIMULATOR

ODD = """
import ctypes, os, sys, torch
print("imported")
NOTHING, NUMBER = None, 3.0
listed = [1, 2]


def loud(theta, action):
    print("simulating")
    ctypes.CDLL(None).puts(b"in C")
    os.write(1, b"past Python")
    return theta[:, :1] * action


def broken(theta, action):
    raise ZeroDivisionError("by zero")


def stopped(theta, action):
    raise KeyboardInterrupt


def left(theta, action):
    sys.exit(3)


def short(theta, action):
    return theta[:1, :1]


def effects():
    raise RuntimeError("no library")
"""
BROKEN = {
    "divides.py": "1 / 0",
    "leaves.py": "raise SystemExit(3)",
    "halves.py": "def f(:",
    "lacks.py": "import no_such_module_at_all",
}
TABLES = {
    "bom.csv": b"\xef\xbb\xbf0.84\n",
    "unit.csv": b"0.84 m\n",
    "semicolon.csv": b"0,84;1\n",
    "empty.csv": b"",
    "utf16.csv": "0.84\n".encode("utf-16"),
    "nul.csv": b"0.8\x004\n",
    "heading.csv": b"distance\n",
    "hollow.csv": b"distance\n\n",
    "quote.csv": b'"0.84\n',
    "nan.csv": b"x\nnan\n",
    "two.csv": b"0.1,0.2\n",
}
TOML = {
    "seed.toml": 'seed = "x"',
    "float.toml": "seed = 1.5",
    "date.toml": "noise = 2026-01-01",
    "table.toml": "[noise]\na = 1",
    "nested.toml": "theta-low = [[0.1], [0]]",
    "flag.toml": "noise = true",
    "method.toml": 'method = "magic"',
    "list.toml": "method = [1, 2]",
    "number.toml": "simulator = 5",
    "trust.toml": "trust = true",
    "half.toml": "seed = ",
    "bytes.toml": "",
}
BOX = ["--theta-low=0.2,0", "--theta-high=1,1"]
INIT = ["init", "new", *BOX, "--num-simulations", "200"]
OF = [*INIT, "--simulator"]
SLED = [*OF, "sled.py:slide", "--noise", "0.02"]
ASK = ["--actions", "1,2"]
#: What is given beside these, so that theirs counts.
GIVEN = {"number.toml": BOX, "nested.toml": ["--theta-high=1,1", *SLED[-4:]]}
CHECK = ["check", "sled.py:slide", *BOX]

#: What has to be told apart by its exit status: 0, or else an error.
CALLS = [
    # Numbers.
    (0, "tell camp -1e-3"),
    (0, "tell camp -.5e2"),
    (0, "tell camp 0.1 --action -1e-3"),
    (0, "tell camp 0.1 --action=-.5e2"),
    (0, "tell camp 1e-20 --json"),
    (0, "correct camp 0 -2e-1 --json"),
    (0, "correct camp 0 --action 2 --json"),
    *(
        (2, ["tell", "camp", x])
        for x in ("", " ", "nan", "inf", "-inf", "1e39", "1e-50", "0,84", "1_000")
    ),
    *(
        (2, ["tell", "camp", x])
        for x in ("0.84 m", "0x10", "None", "1e", "١x", "\ud800")
    ),
    *(
        (2, ["tell", "camp", "0.1", "--action", a])
        for a in ("", "nan", "inf", "1,2", "x")
    ),
    (2, "tell camp"),
    (2, "tell camp 1 2"),
    (2, "tell camp 1 --file bom.csv"),
    (2, "tell camp --invalid --missing"),
    (2, "tell camp 1 --trial 99"),
    (2, "tell camp 1 --trial -1"),
    (2, "tell camp 1 --trial 1.5"),
    (2, "tell camp 1 --trial 99999999999999999999999"),
    (0, "tell camp --invalid --json"),
    (0, "tell camp --missing --json"),
    (2, "correct camp 0"),
    (2, "correct camp 0 --reason typo"),
    (2, ["correct", "camp", "0", ""]),
    (2, "correct camp 7 0.1"),
    (2, "correct camp x 0.1"),
    (2, "withdraw camp -3"),
    (0, ["withdraw", "camp", "0", "--reason", "\n\x1b[31m", "--json"]),
    # Files.
    (0, "tell camp --file bom.csv --json"),
    (0, "correct camp 0 --file bom.csv --json"),
    *((2, f"correct camp 0 --file {name}") for name in TABLES if name != "bom.csv"),
    *((2, f"tell camp --file {name}") for name in ("nan.csv", "none.csv", ".")),
    # Folders.
    *((2, f"{name} nowhere --json") for name in ("status", "ask", "update", "repair")),
    (2, "status sled.py"),
    (2, ["status", ""]),
    (2, ["status", "a\0b"]),
    (2, ["status", "\\1"]),
    (2, "report camp --out no/such/folder/page.html"),
    (2, "export camp --netcdf no/such/folder/x.nc"),
    (0, "report camp --json"),
    (0, "repair camp --json"),
    (0, "status camp --json"),
    # A campaign has its own of these.
    (2, "criticize camp --noise 0.1"),
    (2, "criticize camp --effects no_such_module:effects"),
    (2, "criticize camp --effects odd.py:effects"),
    (2, "criticize camp --effects odd.py:listed"),
    (2, "criticize camp --effects odd.py:NUMBER"),
    (2, "criticize camp --task numerical"),
    (2, "criticize ."),
    # Spaces.
    *(
        (2, [*SLED, "--actions", spec])
        for spec in (
            *("1:2:1000000000", "1:2:0", "1:2:-1", "1:2:1.5", "1:2:²", "2:1"),
            *("nan:1", "0:inf", "1:2:3:4", "", "x", "a:b", "odd.py:NUMBER", "1,,2"),
        )
    ),
    (2, [*SLED, "--actions", "1:2:1000", "1:2:1000"]),
    (0, [*SLED, "--actions", "-1:1"]),
    (0, [*SLED, "--actions", "-5,-4"]),
    *(
        (2, [*SLED, *ASK, *words])
        for words in (
            *(["--noise", "nan"], ["--noise", "0"], ["--noise", "-1"], ["--noise", ""]),
            *(["--noise", "1e39"], ["--names", "a,b"], ["--units", "m,s"]),
            *(["--prior", "odd.py:NUMBER"], ["--prior", "odd.py:NOTHING"]),
            *(
                ["--theta-low", "nan,0"],
                ["--theta-high", "inf,1"],
                ["--theta-low", "1,1"],
            ),
            *(["--num-simulations", "0"], ["--num-simulations", "-5"]),
            *(["--num-workers", "0"], ["--time-limit", "nan"], ["--time-limit", "-1"]),
            *(["--effects", "odd.py:NUMBER"], ["--seed", "1.5"], ["--method", "x"]),
            ["--names", "\udcff"],
        )
    ),
    *((2, [*OF, "sled.py:slide", *ASK, "--config", n]) for n in TOML if n not in GIVEN),
    *((2, ["init", "new", *GIVEN[n], *ASK, "--config", n]) for n in GIVEN),
    # Programs.
    *(
        (2, [*OF, name, *ASK])
        for name in (
            *("sled", "sled.py", "sled.py:", ":slide", "sled.py:none", "none.py:fn"),
            *("odd.py:NUMBER", "odd.py:NOTHING", "..:x", "json.decoder:scanstring "),
            *(f"{name}:f" for name in BROKEN),
        )
    ),
    *((1, [*OF, f"odd.py:{name}", *ASK]) for name in ("broken", "left")),
    (130, [*OF, "odd.py:stopped", *ASK]),
    (2, [*OF, "odd.py:short", *ASK]),
    (1, "check odd.py:broken --theta-low 0 --theta-high 1 --actions 1,2"),
    (2, [*CHECK, "--actions", "1:2:1000000000"]),
    (2, [*CHECK, *ASK, "--noise", "nan"]),
    (2, "bank inspect nowhere"),
    (2, "bank build b --rows 3 --simulator odd.py:NUMBER --prior p:p --actions a:a"),
    (2, "bank build b --rows 3 --task numerical --workers 0"),
    (2, "run numerical --out o --simulations 0"),
    (2, "run numerical --out o --option variant=none"),
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A campaign with a trial and one to come, beside odd files; made once."""
    place = tmp_path_factory.mktemp("odd")
    (place / "sled.py").write_text(SIMULATOR)
    (place / "odd.py").write_text(ODD)
    for name, text in BROKEN.items():
        (place / name).write_text(text)
    for name, content in TABLES.items():
        (place / name).write_bytes(content)
    for name, text in TOML.items():
        (place / name).write_text(text)
    (place / "bytes.toml").write_bytes(b"\xff\xfe")
    small = partial(
        CampaignOptions, details=CampaignDetails(num_scored=500), refinement=REFINEMENT
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(place)
        patch.delitem(sys.modules, "sled", raising=False)
        patch.setattr(sys, "path", [*sys.path])
        patch.setattr(commands, "CampaignOptions", small)
        words = ["--simulator", "sled.py:slide", "--noise", "0.02", "--method", "nsbi"]
        assert main(["init", "camp", *INIT[2:], *words, "--actions", "0.5:3"]) == 0
        assert main(["tell", "camp", "0.3", "--action", "1"]) == 0
        assert main(["ask", "camp"]) == 0
    return place


@pytest.fixture
def camp(folder, tmp_path, monkeypatch, capfd):
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    monkeypatch.setattr(sys, "path", [*sys.path])
    for name in ("sled", "odd", *(Path(name).stem for name in BROKEN)):
        monkeypatch.delitem(sys.modules, name, raising=False)
    capfd.readouterr()


def called(words):
    """Return the exit status of a call, by an error of the parser too."""
    try:
        return main(words.split() if isinstance(words, str) else words)
    except SystemExit as ended:
        return ended.code


def refuse(constant):
    raise AssertionError(f"{constant} is no JSON")


@pytest.mark.parametrize(("status", "words"), CALLS, ids=lambda w: str(w)[:60])
def test_an_odd_call(camp, capfd, status, words):
    assert called(words) == status
    shown = capfd.readouterr()
    if status:
        assert "sbi-active" in shown.err
        assert "Traceback" not in shown.err
    elif "--json" in words:
        json.loads(shown.out, parse_constant=refuse)


def test_numbers_that_are_not_finite_are_null(camp, capfd, monkeypatch):
    infinite = SimpleNamespace(
        mean=torch.tensor([torch.nan, 1.0]), variance=torch.tensor([torch.inf, 4.0])
    )
    monkeypatch.setattr(Campaign, "belief", infinite)
    monkeypatch.setattr(Campaign, "parameter_names", ["a", "b"])
    Path("camp/status.json").unlink()  # what was summed up with another belief
    assert main(["status", "camp", "--json"]) == 0
    answer = json.loads(capfd.readouterr().out, parse_constant=refuse)
    assert answer["belief"]["parameters"] == {
        "a": {"mean": None, "sd": None},
        "b": {"mean": 1.0, "sd": 2.0},
    }


def run(words, **options):
    """Return a call in a process of its own, as a shell makes it."""
    code = "import sys; from sbi_active.cli import main; sys.exit(main())"
    options["env"] = {**os.environ, "OMP_NUM_THREADS": "1", **options.pop("env", {})}
    flags = options.pop("flags", [])
    return subprocess.Popen(
        [sys.executable, *flags, "-c", code, *words],
        stderr=subprocess.PIPE,
        text=True,
        **options,
    )


@pytest.mark.parametrize("workers", [[], ["--num-workers", "2"]])
def test_standard_output_holds_the_answer_alone(camp, workers):
    words = ["--noise", "0.02", "--num-simulations", "200", *workers]
    box = ["--theta-low", "-1,0", "--theta-high", "1,1"]
    assert main(["init", "loud", "--simulator", "odd.py:loud", *box, *ASK, *words]) == 0
    process = run(["ask", "loud", "--json"], stdout=subprocess.PIPE)
    shown, error = process.communicate()
    assert json.loads(shown, parse_constant=refuse)["trial"] == 0
    for text in ("imported", "simulating", "in C", "past Python"):
        assert text in error


@pytest.mark.parametrize("how", ["head", "full"])
def test_nobody_reads_on(camp, how):
    words = ["status", "camp"]
    if how == "head":
        ours, theirs = os.pipe()
        os.close(ours)
    else:
        theirs = os.open("/dev/full", os.O_WRONLY)
    process = run(words, stdout=theirs)
    os.close(theirs)
    _, error = process.communicate()
    assert process.returncode == (1 if how == "head" else 2)
    assert "Traceback" not in error
    assert "Exception ignored" not in error
    assert ("No space left" in error) == (how == "full")


@pytest.mark.parametrize("flags", [[], ["-O"]])
def test_a_locale_that_is_not_utf8(camp, flags):
    env = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONIOENCODING": ""}
    Path("metre.toml").write_text('units = "µm"\nnames = "größe"', encoding="utf-8")
    init = [*SLED, *ASK, "--config", "metre.toml"]
    for words in (init, ["tell", "new", "0.3", "--action", "1"]):
        process = run(words, stdout=subprocess.PIPE, env=env, flags=flags)
        shown, error = process.communicate()
        assert process.returncode == 0, error
    assert "Traceback" not in error
    words = ["correct", "new", "0", "0.4", "--reason", "µ", "--json"]
    process = run(words, stdout=subprocess.PIPE, env=env, flags=flags)
    shown, _ = process.communicate()
    answer = json.loads(shown)
    assert (answer["names"], answer["units"]) == (["größe"], ["µm"])
    assert answer["reason"] == "µ"
    process = run(["report", "new"], stdout=subprocess.PIPE, env=env, flags=flags)
    assert process.wait() == 0
    assert "µm" in Path("new/report.html").read_text(encoding="utf-8")


@pytest.mark.parametrize("sent", [signal.SIGINT, signal.SIGTERM])
def test_stopped_while_it_simulates(camp, sent):
    text = (
        SIMULATOR + "\nimport time\n\n\ndef slow(theta, action):\n    open('on', 'w')\n"
    )
    Path("slow.py").write_text(text + "    time.sleep(60)\n")
    words = ["check", "slow.py:slow", *BOX, *ASK]
    process = run(words, stdout=subprocess.PIPE)
    for _ in range(600):
        if Path("on").exists():
            break
        time.sleep(0.1)
    process.send_signal(sent)
    _, error = process.communicate(timeout=120)
    assert process.returncode == (130 if sent == signal.SIGINT else -signal.SIGTERM)
    assert "Traceback" not in error

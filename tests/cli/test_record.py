"""``tell``, ``correct``, ``withdraw`` and ``status`` without torch, as with it."""

import contextlib
import json
import shutil
import signal
import subprocess
from pathlib import Path

import pytest

from sbi_active import Campaign
from sbi_active.cli import main, record
from sbi_active.cli.problem import open_campaign
from tests.cli.sled import BOX, SIMULATOR, SMALL, forget, forked, made_at, read, run

TWO = SIMULATOR.replace("    return ", "    x = ")
TWO += "    return torch.stack([x[:, 0], 2 * x[:, 0]], 1)\n"


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A campaign of outcomes of two numbers."""
    return made_at(tmp_path_factory, TWO, "0.3", "0.6")


#: Commands that read and write the log alone.
LIGHT = [
    "tell camp 0.4 0.8 --action 1.5 --trial 1 --json",
    "correct camp 0 0.31 0.61 --reason typo",
    "withdraw camp 1",
    "status camp",
]


@pytest.mark.parametrize("words", LIGHT)
def test_neither_torch_nor_numpy_is_imported(camp, words):
    process = run(words.split(), flags=["-X", "importtime"])
    _, error = process.communicate()
    imported = {line.rpartition("|")[2].strip() for line in error.splitlines()}
    assert process.returncode == 0, error
    assert "sqlite3" in imported
    assert not imported & {"torch", "numpy"}


SERIES = [
    ["tell camp 0.4 nan"],
    ["tell camp --missing", "tell camp 0.5 1.0 --action 2.5"],
    [
        "withdraw camp 1 --reason pushed",
        "tell camp 1 2 --action 3",
        "correct camp 2 1 3",
    ],
    ["correct camp 0 0.31 0.61 --reason typo", "correct camp 0 --action 1.5"],
    ["tell camp 0.4 0.8", "tell camp 0.4 0.8", "correct camp 1 0.4 0.8 --reason same"],
    ["tell camp 0.4 0.8 --trial 0 --action 1", "tell camp 1e-20 -1e3"],
]


def log(folder):
    events = Campaign.load(folder).events
    return [{k: v for k, v in event.items() if k != "time"} for event in events]


@pytest.mark.parametrize("series", SERIES, ids=lambda s: s[0][:40])
def test_the_log_and_the_answers_are_the_campaign_s(camp, series, capsys, monkeypatch):
    shutil.copytree(camp, "other")
    answers = []
    for folder in ("camp", "other"):
        capsys.readouterr()
        for words in [*series, "status camp", "status camp"]:
            if folder == "other":  # the campaign itself is loaded
                forget(Path(folder))
            words = words.replace("camp", folder, 1).split()
            assert main([*words, "--json"]) == 0
        shown = capsys.readouterr().out.splitlines()
        answers.append([json.loads(line) for line in shown])
    assert log(Path("camp")) == log(Path("other"))
    assert answers[0] == answers[1]
    one, other = (Campaign.load(name) for name in ("camp", "other"))
    assert repr(one) == repr(other)


@pytest.mark.parametrize("content", ["", "[]", '{"of": 1}', "[" * 99_999])
def test_a_summary_that_is_none_is_not_asked(camp, content, capsys):
    forget(camp, content.encode())
    assert main(["tell", "camp", "0.4", "0.8"]) == 0
    assert main(["status", "camp"]) == 0
    assert "not in the belief yet: [1]" in capsys.readouterr().out


def test_what_is_computed_is_summed_up_no_more(camp):
    assert record.Record(camp).summary
    with open_campaign(camp, "sled.py:slide", [0.02]) as campaign:
        campaign.tell([0.2, 0.4], trial=1)
        assert record.Record(camp).summary["not_in_belief"] == [1]
        campaign.update()
    with pytest.raises(record.Unsure):
        record.Record(camp)


def test_what_was_refused_needs_the_campaign_once(camp, capsys):
    assert main(["tell", "camp", "0.4", "0.8", "--trial", "7"]) == 2
    assert "expected the index of one of 2 trials" in capsys.readouterr().err
    last = Campaign.load(camp).events[-1]
    assert (last["event"], last["x"]) == ("refused", "[0.4, 0.8]")
    assert record.Record(camp).summary["not_in_belief"] == []


def test_several_processes_tell_at_once(camp):
    words = ["tell", "camp", "0.4", "0.8", "--action"]
    telling = [run([*words, str(1 + k / 4)]) for k in range(6)]
    for process in telling:
        _, error = process.communicate(timeout=60)
        assert process.returncode == 0, error
    actions = [t.action.item() for t in Campaign.load(camp).history]
    assert sorted(actions[-6:]) == [1 + k / 4 for k in range(6)]


def test_one_writer_at_a_time(camp, capsys, monkeypatch):
    monkeypatch.setattr("sbi_active.cli.campaign.PATIENCE", 0.2)
    store = record.Store(camp, "campaign")
    store.acquire()
    with contextlib.closing(store):
        assert main(["tell", "camp", "0.4", "0.8"]) == 2
    assert "expected no other writer" in capsys.readouterr().err
    assert main(["tell", "camp", "0.4", "0.8"]) == 0


# ``serve``: a JSON request a line, a JSON answer a line, whatever happens


LOUD = """

def loud(theta, action):
    import os
    print("simulating")
    os.write(1, b"past Python")
    return slide(theta, action)


def broken(theta, action):
    raise ZeroDivisionError("by zero")
"""


@pytest.fixture
def plain(tmp_path):
    """A campaign without trials."""
    (tmp_path / "sled.py").write_text(SIMULATOR + LOUD)
    words = ["--actions", "1,2", "--simulator", "sled.py:loud"]
    sizes = [*SMALL, "--set", "num_samples=100"]
    assert main(["init", "camp", *BOX, *sizes, *words]) == 0


class Server:
    """A session in a process of its own."""

    def __init__(self, *words):
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
        words = ["serve", "camp", *words]
        self.process = forked(words, **pipes, encoding="latin-1")

    def says(self, request):
        line = request if isinstance(request, str) else json.dumps(request)
        self.process.stdin.write(line + "\n")
        self.process.stdin.flush()
        answer = self.process.stdout.readline()
        return read(answer)

    def ends(self):
        _, error = self.process.communicate(timeout=60)
        return self.process.returncode, error


@pytest.fixture
def server(plain):
    started = Server()
    yield started
    started.process.kill()
    started.process.communicate()


def test_a_robot_s_loop(server):
    # Another process may write between two requests.
    assert server.says({"command": "tell", "x": 0.7, "action": 1})["answer"]
    assert main(["tell", "camp", "0.9", "--action", "2"]) == 0
    assert len(server.says({"command": "status"})["answer"]["trials"]) == 2
    asked = server.says({"command": "ask", "id": 7})
    assert asked["id"] == 7
    assert asked["answer"]["names"] == ["action"]
    told = server.says({"command": "tell", "x": 0.7, "trial": asked["answer"]["trial"]})
    assert told["answer"]["x"] == [pytest.approx(0.7)]
    updated = server.says({"command": "update"})["answer"]
    assert updated["not_in_belief"] == []
    again = {"command": "correct", "trial": 0, "x": [0.71], "reason": "read off"}
    assert server.says(again)["answer"]["reason"] == "read off"
    # The campaign that is open is not taken for what another process made of it.
    assert main(["tell", "camp", "0.6", "--action", "2"]) == 0
    assert len(server.says({"command": "status"})["answer"]["trials"]) == 4
    missed = server.says({"command": "tell", "missing": True, "action": [2.0]})
    assert missed["answer"]["status"] == "missing"
    status, error = server.ends()
    assert status == 0, error
    assert "simulating" in error
    assert "past Python" in error


#: Requests, and what their errors say.
WRONG = [
    ("\xff", "expected a JSON object a line; got 'utf-8' codec"),
    ("[" * 100_000, "expected a JSON object a line; got"),
    ('{"id": ' + "[" * 900 + "]" * 900 + "}", "expected a JSON object a line; got"),
    ('{"command": "tell", "x": ' + "[" * 900 + "]" * 900 + "}", "expected options of"),
    ({}, "expected a command among adopt, ask, correct"),
    ({"command": "init"}, "got 'init'"),
    ({"command": "tell", "x": 1, "trail": 0}, "got trail; correct it"),
    ({"command": "tell", "x": [None], "action": 1}, "one of them measured"),
    ({"command": "tell", "x": 1}, "expected a pending trial; got none"),
    ({"command": "withdraw"}, "Missing argument 'TRIAL'"),
    ({"command": "withdraw", "trial": False}, "'False' is not a valid integer"),
    ({"command": "tell", "missing": [1], "action": 1}, "expected options of tell"),
    ({"command": "tell", "file": 5, "action": 1}, "No such file"),
]


def test_errors_are_json_and_the_session_goes_on(plain):
    server = Server("--simulator", "sled.py:broken")
    assert server.says({"command": "ask"})["error"]["status"] in (1, 2)
    for request, text in WRONG:
        answer = server.says(request)
        assert text in answer["error"]["message"]
        assert answer["error"]["status"] == 2
        assert answer["error"]["type"]
    last = server.says('\n{"command": "status", "id": "last"}')
    assert last["id"] == "last"
    assert last["answer"]["trials"] == []
    server.process.send_signal(signal.SIGINT)
    server.process.wait(timeout=60)  # before its input ends, which ends it too
    status, error = server.ends()
    assert status == 130
    assert error.splitlines()[-1].startswith("sbi-active: interrupted")

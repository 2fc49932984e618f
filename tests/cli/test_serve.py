"""``serve``: a JSON request a line, a JSON answer a line, whatever happens."""

import json
import signal
import subprocess

import pytest

from sbi_active.cli import main
from tests.cli.sled import BOX, SIMULATOR, SMALL, forked, read

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
def camp(tmp_path):
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
def server(camp):
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
    assert told["answer"]["status"] == "ok"
    updated = server.says({"command": "update"})["answer"]
    assert updated["not_in_belief"] == []
    again = {"command": "correct", "trial": 0, "x": [0.71], "reason": "read off"}
    assert server.says(again)["answer"]["reason"] == "read off"
    # The campaign that is open is not taken for what another process made of it.
    assert main(["tell", "camp", "0.6", "--action", "2"]) == 0
    assert len(server.says({"command": "status"})["answer"]["trials"]) == 4
    missed = server.says({"command": "tell", "missing": True, "action": [2.0]})
    assert missed["answer"]["action"] == [2.0]
    assert missed["answer"]["status"] == "missing"
    status, error = server.ends()
    assert status == 0, error
    assert "simulating" in error
    assert "past Python" in error


#: Requests, and what their errors say.
WRONG = [
    ("\xff", "expected a JSON object a line; got 'utf-8' codec"),
    ("{", "expected a JSON object a line; got Expecting property name"),
    ("[" * 100_000, "expected a JSON object a line; got"),
    ('{"id": ' + "[" * 900 + "]" * 900 + "}", "expected a JSON object a line; got"),
    ('{"command": "tell", "x": ' + "[" * 900 + "]" * 900 + "}", "expected options of"),
    ("[1]", "expected a JSON object a line"),
    ({}, "expected a command among adopt, ask, correct"),
    ({"command": ["ask"]}, "expected a command among adopt"),
    ({"command": "init"}, "got 'init'"),
    ({"command": "tell", "x": 1, "trail": 0}, "got trail; correct it"),
    ({"command": "tell", "x": [None], "action": 1}, "one of them measured"),
    ({"command": "tell", "x": 1}, "expected a pending trial; got none"),
    ({"command": "withdraw"}, "Missing argument 'TRIAL'"),
    ({"command": "withdraw", "trial": 0.5}, "'0.5' is not a valid integer"),
    ({"command": "withdraw", "trial": False}, "'False' is not a valid integer"),
    ({"command": "tell", "missing": [1], "action": 1}, "expected options of tell"),
    ({"command": "tell", "file": 5, "action": 1}, "No such file"),
]


def test_errors_are_json_and_the_session_goes_on(camp):
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

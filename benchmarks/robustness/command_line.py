"""Attacks on the command line in its own processes: words, pipes, signals, locales."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from benchmarks.robustness.attacks import Attacks
from sbi_active import Campaign
from sbi_active.cli import main

ATTACKS = Attacks()
PROGRAM = str(Path(sys.executable).with_name("sbi-active"))
SLED = (
    "def slide(theta, action):\n    print('noise')\n    return theta[:, :1] * action\n"
)
INIT = [
    *("init", "camp", "--simulator", "sled.py:slide", "--actions=-2:2"),
    *("--noise", ".1", "--theta-low", "0.2,-1", "--theta-high", "1,1"),
    *("--num-simulations", "200", "--num-samples", "50", "--method", "nsbi"),
]


def call(*words: str, **options: Any) -> subprocess.CompletedProcess[str]:
    """Run the command line in a process, with no traceback whatever comes."""
    command = [PROGRAM, *words]
    options = {"capture_output": True, "encoding": "utf-8", "timeout": 110, **options}
    done = subprocess.run(command, check=False, **options)
    assert "Traceback" not in (done.stderr or ""), done.stderr[-400:]
    return done


def begun() -> None:
    """Make the campaign that is attacked."""
    Path("sled.py").write_text(SLED)
    sys.path.insert(0, "")
    assert main(INIT) == 0


def history() -> list[tuple[str, float | None]]:
    """Return each trial's status and outcome."""
    return [
        (t.status, None if t.x is None else round(float(t.x), 6))
        for t in Campaign.load("camp").history
    ]


@ATTACKS.add(
    "numbers told", cases=("-1e-3", "-.5e2", "-2", "-3.", "-0.25", "+1", "1e-30")
)
def told(text: str) -> None:
    begun()
    done = call("tell", "camp", text, "--action", "-1e-1")
    assert done.returncode == 0, done.stderr
    assert history() == [("ok", round(float(text), 6))], history()


NOT_NUMBERS = ("", " ", "inf", "1e39", "nan", "0.84 m", "O", "1,2", "1;2", "0x1", "١")


@ATTACKS.add("what is no number", cases=NOT_NUMBERS)
def not_told(text: str) -> None:
    begun()
    done = call("tell", "camp", text, "--action", "1")
    if text == "١" and done.returncode == 0:  # a digit that Python reads as 1
        assert history() == [("ok", 1.0)], history()
        return
    assert done.returncode == 2, done.stdout
    assert "expected" in done.stderr, done.stderr
    assert history() == []


ODD: dict[str, list[str]] = {
    "no command": [],
    "unknown command": ["fly"],
    "no folder": ["status", "nowhere"],
    "a file as folder": ["status", "sled.py"],
    "folder empty": ["status", ""],
    "action of two": ["tell", "camp", "1", "--action", "1,2"],
    "action text": ["tell", "camp", "1", "--action", "fast"],
    "trial unknown": ["tell", "camp", "1", "--trial", "99"],
    "trial negative": ["tell", "camp", "1", "--trial", "-1"],
    "correct nothing": ["correct", "camp", "0", "1"],
    "withdraw nothing": ["withdraw", "camp", "0"],
    "seed text": [*INIT, "--seed", "x"],
    "sizes of 0": [*INIT[:-4], "--num-samples", "0"],
    "sizes of 1e18": [*INIT, "--num-simulations", "1000000000000000000"],
    "actions of 1e9": [*INIT, "--actions=1:2:1000000000"],
    "actions NaN": [*INIT, "--actions=nan:2"],
    "actions the wrong way": [*INIT, "--actions=2:1"],
    "noise negative": [*INIT, "--noise=-1"],
    "bounds of two lengths": [*INIT, "--theta-low", "0,0,0"],
    "method unknown": [*INIT, "--method", "magic"],
    "simulator unknown": [*INIT, "--simulator", "nothing.py:f"],
    "simulator without name": [*INIT, "--simulator", "sled.py"],
    "simulator's name unknown": [*INIT, "--simulator", "sled.py:fly"],
    "a folder that is taken": INIT,
    "effects unknown": ["criticize", "camp", "--effects", "nothing.py"],
    "export unknown": ["export", "camp", "--format", "x"],
    "bank unknown": ["bank", "info", "nowhere.h5"],
    "a NUL": ["status", "camp\udcff"],
    "very long": ["status", "c" * 5_000],
    "help": ["--help"],
    "version": ["--version"],
}


@ATTACKS.add("odd calls", cases=list(ODD))
def odd(name: str) -> None:
    begun()
    done = call(*ODD[name])
    if name in ("help", "version"):
        assert done.returncode == 0, done.stderr
    else:
        assert done.returncode in (1, 2), (done.returncode, done.stdout)
        assert done.stderr.strip(), done.stdout
    assert history() == []


@ATTACKS.add("JSON alone on the output", cases=("ask", "status", "update"))
def as_json(command: str) -> None:
    begun()
    assert main(["tell", "camp", "0.5", "--action", "1"]) == 0
    done = call(command, "camp", "--json")
    assert done.returncode == 0, done.stderr

    def refuse(text: str) -> None:
        raise AssertionError(f"{text} is not JSON")

    json.loads(done.stdout, parse_constant=refuse)


@ATTACKS.add(
    "a pipe that closes",
    cases=("status camp", "--help", "check camp", "report camp"),
)
def pipe(words: str) -> None:
    begun()
    command = [PROGRAM, *words.split()]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as child:
        assert child.stdout is not None
        assert child.stderr is not None
        child.stdout.close()
        error = child.stderr.read()
    assert "Traceback" not in error, error[-300:]


@ATTACKS.add(
    "a signal while it works",
    cases=[
        (name, command)
        for name in ("SIGINT", "SIGTERM")
        for command in ("ask", "update", "tell")
    ],
)
def interrupted(case: tuple[str, str]) -> None:
    name, command = case
    begun()
    assert main(["tell", "camp", "0.5", "--action", "1"]) == 0
    words = [command, "camp", *(["0.7", "--action", "1"] if command == "tell" else [])]
    with subprocess.Popen(
        [PROGRAM, *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as child:
        time.sleep(4.0)
        child.send_signal(getattr(signal, name))
        _, error = child.communicate()
    assert "Traceback" not in error, error[-300:]
    found = history()
    assert found[0] == ("ok", 0.5)
    assert call("tell", "camp", "0.9", "--action", "1").returncode == 0
    assert ("ok", 0.9) in history()


@ATTACKS.add(
    "a locale that is not UTF-8",
    cases=[
        (locale, command)
        for locale in ("C", "POSIX", "de_DE.ISO-8859-1")
        for command in ("status camp", "report camp", "tell camp .4")
    ],
)
def locale(case: tuple[str, str]) -> None:
    value, words = case
    begun()
    plain = {
        "LC_ALL": value,
        "PYTHONUTF8": "0",
        "PYTHONCOERCECLOCALE": "0",
        "PYTHONIOENCODING": "",
    }
    environment = {**os.environ, **plain}
    rest = ["--action", "1"] if words.startswith("tell") else []
    done = call(*words.split(), *rest, env=environment, errors="replace")
    assert done.returncode == 0, done.stderr


@ATTACKS.add(
    "a folder of a stranger",
    cases=("status", "report", "tell", "correct", "withdraw", "ask", "update"),
)
def stranger(command: str) -> None:
    begun()
    assert main(["tell", "camp", "0.5", "--action", "1"]) == 0
    # The folder brings a program of its own under the simulator's name.
    settings = Path("camp", "command.json")
    text = settings.read_text().replace(str(Path("sled.py").absolute()), "evil.py")
    settings.write_text(text.replace("sled.py", str(Path("camp/evil.py").absolute())))
    Path("camp", "evil.py").write_text(
        "open('ran', 'w').write('x')\n" + SLED.replace("print('noise')", "pass")
    )
    rest = {
        "tell": ["0.7", "--action", "1"],
        "correct": ["0", "0.6", "--reason", "typo"],
        "withdraw": ["0", "--reason", "slipped"],
    }
    call(command, "camp", *rest.get(command, []))
    assert not Path("ran").exists()


LINES: dict[str, bytes] = {
    "no JSON": b"ask",
    "half of it": b'{"command": "ask"',
    "a list": b"[1]",
    "no encoding": b"\xff\xfe{}",
    "a NUL": b'{"command": "st\x00atus"}',
    "nested": b"[" * 100_000,
    "very long": b'{"command": "' + b"a" * 1_000_000 + b'"}',
    "no command": b"{}",
    "a command of the shell": b'{"command": "init", "folder": "new"}',
    "another folder": b'{"command": "status", "folder": "/tmp"}',
    "trust": b'{"command": "status", "trust": true}',
    "text as x": b'{"command": "tell", "x": "fast", "action": 1}',
    "nothing as x": b'{"command": "tell", "x": null, "action": 1}',
    "infinite": b'{"command": "tell", "x": [Infinity], "action": 1}',
    "two numbers": b'{"command": "tell", "x": [1, 2], "action": 1}',
    "an object as x": b'{"command": "tell", "x": {"a": 1}, "action": 1}',
    "a huge trial": b'{"command": "tell", "x": 1, "trial": 1e400}',
    "a flag as text": b'{"command": "tell", "missing": "perhaps", "action": 1}',
}


@ATTACKS.add("lines for a session", cases=list(LINES))
def served(name: str) -> None:
    begun()
    lines = [LINES[name], b'{"command": "status", "id": 1}', b""]
    done = call(
        "serve", "camp", input=b"\n".join(lines).decode("latin-1"), encoding="latin-1"
    )
    assert done.returncode == 0, done.stderr
    error, last = map(json.loads, done.stdout.splitlines())
    assert error["error"]["status"] in (1, 2), error
    assert last["id"] == 1, last
    assert last["answer"]["trials"] == [], last
    assert history() == []

"""CPU seconds until the library answers: imports beside sbi's, and the command line.

    python -m benchmarks cost.doors

Each line is a process of its own; lines are run in turn, three times over, and the
median counts. Those on a campaign are a round of a robot's loop, in a new folder each
time.
"""

from __future__ import annotations

import json
import resource
import statistics
import subprocess
import sys
import tempfile
from datetime import date
from pathlib import Path

from benchmarks.rows import keep

NUM_RUNS = 3

_MAIN = "import sys; from sbi_active.cli import main; sys.exit(main(sys.argv[1:]))"
DOORS = {
    "import sbi.inference": ["-c", "import sbi.inference"],
    "import sbi_active": ["-c", "import sbi_active"],
    "from sbi_active import ASBI": ["-c", "from sbi_active import ASBI"],
    "from sbi_active import Campaign": ["-c", "from sbi_active import Campaign"],
    "sbi-active --help": ["-c", _MAIN, "--help"],
    "sbi-active --version": ["-c", _MAIN, "--version"],
    "sbi-active run --help": ["-c", _MAIN, "run", "--help"],
    "sbi-active rnu": ["-c", _MAIN, "rnu"],
    "sbi-active run numerica": ["-c", _MAIN, "run", "numerica", "--out", "."],
    "sbi-active run --roundz 3": ["-c", _MAIN, "run", "numerical", "--roundz", "3"],
}
SIMULATOR = """
def slide(theta, action):
    friction, drag = theta[:, :1], theta[:, 1:]
    return action**2 / (2 * 9.81 * friction) / (1 + drag * action)
"""
INIT = (
    "init camp --simulator sled.py:slide --noise 0.02 --theta-low 0.2,0 "
    "--theta-high 1,1 --actions 0.5:3 --method nsbi --set num_simulations=200"
)
ROUND = (
    "ask camp",
    "tell camp 0.7",
    "status camp",
    "correct camp 0 0.71",
    "update camp",
    "withdraw camp 0",
)
#: The same round by one session, whose requests these are.
SERVED = (
    {"command": "ask"},
    {"command": "tell", "x": 0.7},
    {"command": "status"},
    {"command": "correct", "trial": 0, "x": 0.71},
    {"command": "update"},
    {"command": "withdraw", "trial": 0},
)


def cpu_seconds(
    arguments: list[str], folder: str | None = None, said: str = ""
) -> float:
    """Return user and system time of one process of this Python.

    Args:
        arguments: Of the process.
        folder: Where it runs; None is here.
        said: To its standard input.
    """
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    command = [sys.executable, *arguments]
    subprocess.run(
        command, capture_output=True, check=False, cwd=folder, input=said.encode()
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime


def loop_seconds() -> dict[str, float]:
    """Return CPU seconds of each command of a round, and of the round by a session."""
    found = {}
    with tempfile.TemporaryDirectory() as folder:
        Path(folder, "sled.py").write_text(SIMULATOR)
        for words in (INIT, *ROUND):
            seconds = cpu_seconds(["-c", _MAIN, *words.split()], folder)
            found[f"sbi-active {words.partition(' --')[0]}"] = seconds
        again = INIT.replace("camp", "other").split()
        cpu_seconds(["-c", _MAIN, *again], folder)
        said = "".join(json.dumps(request) + "\n" for request in SERVED)
        seconds = cpu_seconds(["-c", _MAIN, "serve", "other"], folder, said)
        found[f"sbi-active serve other, {len(SERVED)} requests"] = seconds
    return found


def main() -> None:
    """Print the table and keep it."""
    runs = [
        {name: cpu_seconds(line) for name, line in DOORS.items()} | loop_seconds()
        for _ in range(NUM_RUNS)
    ]
    medians = {name: statistics.median(run[name] for run in runs) for name in runs[0]}
    for name, seconds in medians.items():
        print(f"{name:36} {seconds:6.3f} CPU s")
    result = {"date": date.today().isoformat(), "cpu_s": medians}
    path = Path(__file__).parent / "doors.json"
    keep(path, result)

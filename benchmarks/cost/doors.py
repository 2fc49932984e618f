"""CPU seconds until the library answers: imports beside sbi's, and the command line.

    python -m benchmarks cost.doors

Each line is a process of its own; lines are run in turn, three times over, and the
median counts. ``-X importtime`` then names the slowest of what is imported.
"""

from __future__ import annotations

import json
import re
import resource
import statistics
import subprocess
import sys
from datetime import date
from pathlib import Path

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


def cpu_seconds(arguments: list[str]) -> float:
    """Return user and system time of one process of this Python."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, *arguments], capture_output=True, check=False)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime


def slowest_imports(statement: str, num: int = 5) -> list[tuple[str, float]]:
    """Return the packages that a statement imports, by their own time in seconds."""
    command = [sys.executable, "-X", "importtime", "-c", statement]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    own: dict[str, float] = {}
    for microseconds, name in re.findall(r"(\d+) \|\s+\d+ \|\s+(\S+)", done.stderr):
        package = name.partition(".")[0]
        own[package] = own.get(package, 0.0) + int(microseconds) / 1e6
    return sorted(own.items(), key=lambda item: -item[1])[:num]


def main() -> None:
    """Print the table and keep it."""
    runs = [
        {name: cpu_seconds(line) for name, line in DOORS.items()}
        for _ in range(NUM_RUNS)
    ]
    medians = {name: statistics.median(run[name] for run in runs) for name in DOORS}
    for name, seconds in medians.items():
        print(f"{name:32} {seconds:6.3f} CPU s")
    imports = {statement: slowest_imports(statement) for statement in [*DOORS][:4]}
    for statement, packages in imports.items():
        listed = ", ".join(f"{name} {seconds:.2f}" for name, seconds in packages)
        print(f"{statement}: {listed} s")
    result = {"date": date.today().isoformat(), "cpu_s": medians, "imports_s": imports}
    path = Path(__file__).parent / "doors.json"
    path.write_text(json.dumps(result, indent=2) + "\n")

"""One command runs every benchmark."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.__main__ import benchmarks, main, module_of, parser_of

ROOT = Path(__file__).parents[2]


def test_a_name_is_a_module_or_a_folder():
    assert module_of("oracles") == "benchmarks.oracles.run"
    assert module_of("oracles.calibration") == "benchmarks.oracles.calibration"
    assert module_of("benchmarks.flag.run") == "benchmarks.flag.run"


def test_options_are_arguments():
    def run(
        *,
        summary: bool = False,
        seeds: list[int] | None = None,
        first_seed: int = 3,
        path: Path = ROOT,
    ) -> None:
        """Run.

        Args:
            summary: Whether to run nothing.
        """

    parse = parser_of(run, "some").parse_args
    assert vars(parse([])) == {
        "summary": False,
        "seeds": None,
        "first_seed": 3,
        "path": ROOT,
    }
    options = "--summary --seeds 1 2 --path a --first-seed 4"
    given = parse(options.split())
    assert vars(given) == {
        "summary": True,
        "seeds": [1, 2],
        "first_seed": 4,
        "path": Path("a"),
    }
    with pytest.raises(SystemExit):
        parse(["--seeds", "one"])


def test_an_unknown_name_is_an_error_with_those_alike(capsys):
    assert main(["oracle"]) == 2
    assert "got 'oracle'" in capsys.readouterr().err


def test_all_are_listed(capsys):
    assert main([]) == 0
    printed = capsys.readouterr().out
    assert {"oracles", "flag", "measured.go2", "table"} <= {*benchmarks()}
    for name, line in benchmarks().items():
        assert re.search(rf"^{re.escape(name)} +{re.escape(line)}$", printed, re.M)
        assert line, name


def test_one_reads_its_own_command_line(capsys):
    assert main(["table", "cost/doors.json", "--only", "nothing*"]) == 0
    assert capsys.readouterr().out.startswith("| what | value |")


def test_it_runs_as_a_process():
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks", "oracles", "--summary"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    assert "| compartments_10 |" in done.stdout

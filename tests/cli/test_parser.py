"""Help, the version and slips of the pen are answered before torch is imported."""

import importlib
import subprocess
import sys

import pytest

from sbi_active import __version__
from sbi_active.campaign.learning import methods
from sbi_active.cli import main, parser, run
from sbi_active.tasks import TASKS  # pyright: ignore

#: Exit status, and which of what takes seconds to import has been imported.
COMMAND = """
import sys
from sbi_active.cli import main
try:
    main()
finally:
    heavy = {"torch", "numpy", "scipy", "sbi", "matplotlib", "pandas", "arviz"}
    print("imported:", sorted(heavy & {*sys.modules}))
"""


@pytest.mark.parametrize(
    ("arguments", "status", "text"),
    [
        (["--help"], 0, "find what a simulator lacks, from measured trials"),
        (["run", "--help"], 0, "one of: asbi, nsbi, alhi, nlhi, seqbed"),
        (["--version"], 0, __version__),
        ([], 2, "the following arguments are required: COMMAND"),
        (["rnu"], 2, "invalid choice: 'rnu' (choose from"),
        (["run", "numerica", "--out", "d"], 2, "TASK: invalid choice: 'numerica'"),
        (["run", "numerical", "--method", "abc"], 2, "--method: invalid choice: 'abc'"),
        (["run", "numerical", "--roundz", "3", "--out", "d"], 2, "--roundz"),
    ],
)
def test_nothing_heavy_is_imported(arguments, status, text):
    done = subprocess.run(
        [sys.executable, "-c", COMMAND, *arguments], capture_output=True, text=True
    )
    assert done.returncode == status
    assert text in done.stdout + done.stderr
    assert done.stdout.endswith("imported: []\n")


@pytest.mark.parametrize(
    "arguments",
    [
        ["run", "numerical", "--out", "d", "--rounds", "0"],
        ["bank", "build", "d", "--task", "numerical", "--rows", "0"],
        ["check", "--task", "numerical", "--workers", "0"],
        ["check", "--task", "numerical", "--rows", "1.5"],
    ],
)
def test_counts_are_at_least_one(arguments, capsys):
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert ended.value.code == 2
    text = f"expected a whole number >= 1; got {arguments[-1]!r}"
    assert text in capsys.readouterr().err


def test_names_are_those_of_the_library():
    assert (*TASKS,) == parser.TASKS
    assert (*methods.METHODS,) == parser.METHODS
    assert (*run.SETTINGS,) == parser.SETTINGS


@pytest.mark.parametrize(
    "arguments",
    [
        ["run", "numerical", "--out", "d"],
        ["bank", "build", "d", "--task", "numerical", "--rows", "1"],
        ["bank", "inspect", "d"],
        ["check"],
        ["criticize", "t.csv", "--task", "numerical"],
    ],
)
def test_every_command_has_its_function(arguments):
    module, function = parser.make_parser().parse_args(arguments).command
    assert callable(
        getattr(importlib.import_module(f"sbi_active.cli.{module}"), function)
    )

"""Help, the version and slips of the pen are answered before torch is imported."""

import importlib
import subprocess
import sys

import click
import pytest

from sbi_active import __version__
from sbi_active.campaign.learning import methods
from sbi_active.cli import commands, main, run
from sbi_active.tasks import TASKS  # pyright: ignore

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


@pytest.mark.parametrize(
    ("arguments", "status", "text"),
    [
        (["--help"], 0, "Find what a simulator lacks"),
        (["-h"], 0, "130 after an interrupt"),
        (["run", "--help"], 0, "[asbi|nsbi|alhi|nlhi|seqbed]"),
        (["--version"], 0, __version__),
        ([], 2, "Missing command."),
        (["rnu"], 2, "No such command 'rnu'"),
        (["bank", "biuld"], 2, "No such command 'biuld'"),
        (
            ["run", "numerica", "--out", "d"],
            2,
            "is not one of 'numerical', 'oscillator'",
        ),
        (
            ["run", "numerical", "--method", "abc"],
            2,
            "'abc' is not one of 'asbi', 'nsbi'",
        ),
        (
            ["run", "numerical", "--roundz", "3", "--out", "d"],
            2,
            "No such option '--roundz'",
        ),
        (["run", "numerical"], 2, "Missing option '--out'"),
        (["tell", "c", "--qqqq"], 2, "No such option '--qqqq'"),
        (
            ["correct", "c", "0", "--reason", "--json"],
            2,
            "'--reason' requires an argument",
        ),
    ],
)
def test_nothing_heavy_is_imported(arguments, status, text):
    done = subprocess.run(
        [sys.executable, "-c", COMMAND, *arguments], capture_output=True, text=True
    )
    assert done.returncode == status
    assert text in " ".join((done.stdout + done.stderr).split())
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
    assert main(arguments) == 2
    text = capsys.readouterr().err
    assert f"Invalid value for '{arguments[-2]}': " in text
    assert arguments[-1] in text


def test_names_are_those_of_the_library():
    assert (*TASKS,) == commands.TASKS
    assert (*methods.METHODS,) == commands.METHODS
    assert (*run.SETTINGS,) == commands.SETTINGS


def every_command(group=commands.main):
    for command in group.commands.values():
        yield from (
            every_command(command) if isinstance(command, click.Group) else [command]
        )


@pytest.mark.parametrize("command", every_command(), ids=lambda c: c.name)
def test_every_command_has_its_function(command):
    *module, function = command.callback.args[0].split(".")
    function = function.replace("repair", "status")
    homes = [
        importlib.import_module(f"sbi_active.cli.{name}")
        for name in module or ("trials", "campaign")
    ]
    assert any(callable(getattr(home, function, None)) for home in homes)


#: Of release 0.1.0, each with the options that it had.
NAMES = {
    "run": "--method --rounds --seed --out --option --setting --simulations --samples "
    "--iterations",
    "bank build": "--task --simulator --option --prior --actions --simulator-version "
    "--rows --seed --workers",
    "bank inspect": "",
    "check": "--task --theta-low --theta-high --prior --actions --noise --rows "
    "--rounds --workers --seed",
    "criticize": "--trust --config --columns --units --order --inputs --input-hold "
    "--no-thin --task --simulator --prior --theta-low --theta-high --noise --actions "
    "--effects --designed --out --seed",
    "init": "--config --simulator --prior --theta-low --theta-high --actions --names "
    "--units --noise --effects --method --num-simulations --num-samples --num-workers "
    "--time-limit --seed",
    "ask": "--simulator --target --json --trust",
    "tell": "--file --invalid --missing --action --trial --json --trust",
    "correct": "--file --invalid --missing --action --reason --json --trust",
    "withdraw": "--reason --json --trust",
    "status": "--json --trust",
    "repair": "--json --trust",
    "update": "--simulator --simulator-changed --json --trust",
    "adopt": "--simulator --effects --json --trust",
    "report": "--out --json --trust",
    "export": "--simulator --netcdf --seed --json --trust",
}


@pytest.mark.parametrize("name", NAMES)
def test_former_commands_and_options_are_there(name, capsys):
    assert main([*name.split(), "--help"]) == 0
    shown = capsys.readouterr().out.split()
    assert {*NAMES[name].split(), "-h,", "--help"} <= {*shown}

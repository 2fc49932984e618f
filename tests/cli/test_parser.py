"""Help, the version, slips of the pen and completion, before torch is imported."""

import subprocess
import sys

import pytest

from sbi_active import __version__
from sbi_active.campaign.learning import methods
from sbi_active.cli import declare, main
from tests.cli.sled import read, run

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
        (["run", "-h"], 0, "[asbi|nsbi|alhi|nlhi|seqbed]"),
        (["--version"], 0, __version__),
        (["biuld"], 2, "No such command 'biuld'"),
        (["run", "numerical", "--roundz", "3", "--out", "d"], 2, "option '--roundz'"),
    ],
)
def test_nothing_heavy_is_imported(arguments, status, text):
    words = [sys.executable, "-c", COMMAND, *arguments]
    done = subprocess.run(words, capture_output=True, text=True)
    assert done.returncode == status
    assert text in " ".join((done.stdout + done.stderr).split())
    assert done.stdout.endswith("imported: []\n")


@pytest.mark.parametrize(
    ("line", "kind", "text"),
    [
        ("fly camp", "NoSuchCommand", "No such command 'fly'"),
        ("ask camp --targt x", "NoSuchOption", "No such option '--targt'"),
        ("status nowhere", "ValueError", "expected a campaign; got no nowhere"),
        ("status \ud800", "UnicodeEncodeError", "surrogates not allowed"),
    ],
)
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

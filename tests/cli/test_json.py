"""What a program reads: JSON on success and on errors, statuses, words of a shell."""

import json
import os
import subprocess
import sys

import pytest

from sbi_active.cli import main


def refuse(constant):
    raise AssertionError(f"{constant} is no JSON")


@pytest.mark.parametrize(
    ("words", "kind", "text"),
    [
        (["status", "nowhere"], "ValueError", "expected a campaign; got no nowhere"),
        (["status"], "MissingParameter", "Missing argument 'DIR'"),
        (["tell", "camp", "--faster"], "NoSuchOption", "No such option '--faster'"),
        (["withdraw", "camp", "one"], "BadParameter", "'one' is not a valid integer"),
        (["fly", "camp"], "NoSuchCommand", "No such command"),
        (["export", "camp"], "MissingParameter", "Missing option '--netcdf'"),
        (["status", "\ud800"], "UnicodeEncodeError", "surrogates not allowed"),
    ],
)
def test_an_error_is_json_as_well(words, kind, text, capfd):
    assert main([*words, "--json"]) == 2
    shown = capfd.readouterr()
    error = json.loads(shown.out, parse_constant=refuse)["error"]
    assert (error["type"], error["status"]) == (kind, 2)
    assert text in error["message"]
    assert shown.err.startswith("sbi-active: ")


@pytest.mark.parametrize(
    ("raised", "status"),
    [(KeyboardInterrupt, 130), (RuntimeError("odd"), 1), (OSError("full"), 2)],
)
def test_statuses_of_errors_are_in_the_json(raised, status, capsys, monkeypatch):
    def fail(*_, **__):
        raise raised

    monkeypatch.setattr("sbi_active.cli.campaign.open_campaign", fail)
    assert main(["update", "camp", "--json"]) == status
    answer = json.loads(capsys.readouterr().out, parse_constant=refuse)
    assert answer["error"]["status"] == status
    assert answer["error"]["message"]


def completed(line, shell="bash"):
    """Return what the shell offers behind a line."""
    code = "import sys; from sbi_active.cli import main; sys.exit(main())"
    words = line.split(" ")
    env = {
        **os.environ,
        "_SBI_ACTIVE_COMPLETE": f"{shell}_complete",
        "COMP_WORDS": line,
        "COMP_CWORD": str(len(words) - 1),
    }
    done = subprocess.run(
        [sys.executable, "-c", code], env=env, capture_output=True, text=True
    )
    return [row.partition(",")[2] for row in done.stdout.splitlines()]


def test_a_shell_completes_commands_options_and_names():
    assert completed("sbi-active st") == ["status"]
    assert completed("sbi-active tell camp --mis") == ["--missing"]
    assert completed("sbi-active init camp --method nl") == ["nlhi"]
    assert completed("sbi-active run box") == ["box_collision"]
    assert completed("sbi-active bank b") == ["build"]


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_the_words_for_a_shell_are_printed(shell, capsys, monkeypatch):
    monkeypatch.setenv("_SBI_ACTIVE_COMPLETE", f"{shell}_source")
    assert main([]) == 0
    assert "_SBI_ACTIVE_COMPLETE" in capsys.readouterr().out

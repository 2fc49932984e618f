"""README's table is what committed rows say, and holds what is stated of it."""

from pathlib import Path

import pytest

from benchmarks import table as readme
from benchmarks.__main__ import main

README = Path(__file__).parents[2] / "README.md"


def test_readme_shows_the_rows_and_no_value_is_missed():
    lines, misses = readme.table()
    assert "\n" + "\n".join(lines) + "\n\n" in README.read_text()
    assert not misses


@pytest.mark.parametrize("way", ["least = { ratio = 1e3 }", "most = { ratio = 1 }"])
def test_a_missed_value_is_said_and_is_a_failure(tmp_path, monkeypatch, capsys, way):
    stated = tmp_path / "stated.toml"
    text = """
[[row]]
figures = "training"
what = "training"
result = "{ratio:.0f}"
beside = ""
"""
    stated.write_text(text + way)
    monkeypatch.setattr(readme.table, "__defaults__", (stated,))
    assert main(["table", "readme"]) == 1
    printed = capsys.readouterr()
    assert printed.out.endswith("| training | 43 | |\n")
    assert "training: expected ratio at" in printed.err

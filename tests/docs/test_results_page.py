"""What benchmarks print becomes tables of the site, cell by cell."""

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def results() -> ModuleType:
    path = ROOT / "docs" / "_ext" / "results.py"
    spec = importlib.util.spec_from_file_location("results", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    pytest.importorskip("sphinx")
    spec.loader.exec_module(module)
    return module


def test_columns_end_where_their_rule_does(results):
    text = (
        "           gap  regret\n"
        "----  --------  ------\n"
        "asbi  .1 | .2     0.00\n"
        "nsbi       nan         \n"
        "a line that is no row of the table\n"
    )
    assert results.as_markdown(text).split("\n") == [
        "|  | gap | regret |",
        "| --- | --- | --- |",
        "| asbi | .1 \\| .2 | 0.00 |",
        "| nsbi |  |  |",
        "",
        "```text",
        "a line that is no row of the table",
        "```",
        "",
    ]


def test_markdown_and_headings_pass(results):
    text = "\n## world A\n| a | b |\n|---|---|\n| 1 | 2 |\n\nCPU s: 3"
    lines = results.as_markdown(text).split("\n")
    assert lines[0] == "**world A**"
    assert lines[2:5] == ["| a | b |", "|---|---|", "| 1 | 2 |"]
    assert lines[-4:] == ["```text", "CPU s: 3", "```", ""]


def test_committed_rows_are_printed_and_their_absence_is_a_fault(results, monkeypatch):
    text = results.printed("benchmarks.forces.run --summary")
    assert "| single: right family |" in results.as_markdown(text)
    with pytest.raises(ValueError, match="commit its rows"):
        results.printed("benchmarks.calibration.run --summary --first 1000000")

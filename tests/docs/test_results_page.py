"""What benchmarks print becomes tables of the site, cell by cell."""

import importlib.util
import re
from pathlib import Path
from types import ModuleType

import pytest

from benchmarks.__main__ import main as run

ROOT = Path(__file__).parents[2]
#: Numbers of docs/benchmarks.md that were chosen and not measured: a level of a test,
#: the range of a correlation.
SETTINGS = {"0.01", "0.98"}


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


def test_committed_rows_are_printed_and_their_absence_is_a_fault(results, monkeypatch):
    text = results.printed("forces --summary")
    assert "| single: right family |" in results.as_markdown(text)
    with pytest.raises(ValueError, match="commit its rows"):
        results.printed("calibration.beliefs --summary --seeds 1000000 1000001")


def test_each_section_shows_its_tables(results):
    text = (ROOT / "docs" / "benchmarks.md").read_text(encoding="utf-8")
    included = re.findall(r"{include} reference/api/results/(.+)", text)
    assert included == [
        results.file_of(t).name
        for t in re.findall("## (.+)", text)
        if t in results.TABLES
    ]
    assert {*included} == {results.file_of(title).name for title in results.TABLES}


def test_a_file_is_a_table(capsys, tmp_path):
    (tmp_path / "rows.csv").write_text("a,b\n1,x|y\n")
    (tmp_path / "runs.json").write_text('{"cpu": {"ours": 1.25}, "date": "today"}')
    for arguments in (["rows.csv"], ["runs.json", "--only", "cpu*"]):
        run(["table", str(tmp_path / arguments[0]), *arguments[1:]])
    assert capsys.readouterr().out.splitlines() == [
        "| a | b |",
        "| --- | ---: |",
        "| 1 | x\\|y |",
        "| what | value |",
        "| --- | ---: |",
        "| cpu, ours | 1.25 |",
    ]

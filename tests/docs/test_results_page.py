"""What benchmarks print becomes tables of the site, cell by cell."""

import importlib.util
import re
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def results() -> ModuleType:
    path = ROOT / "docs" / "_ext" / "results.py"
    spec = importlib.util.spec_from_file_location("results", path)
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


def test_each_section_shows_its_tables(results):
    text = (ROOT / "docs" / "benchmarks.md").read_text(encoding="utf-8")
    included = re.findall(r"{include} reference/api/results/(.+)", text)
    assert included == [
        results.file_of(t).name
        for t in re.findall("## (.+)", text)
        if t in results.TABLES
    ]
    assert {*included} == {results.file_of(title).name for title in results.TABLES}

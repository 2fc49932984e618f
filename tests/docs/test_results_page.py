"""What benchmarks print becomes tables of the site, from committed rows."""

import importlib.util
import re
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def page() -> ModuleType:
    path = ROOT / "docs" / "_ext" / "results.py"
    spec = importlib.util.spec_from_file_location("results", path)
    module = importlib.util.module_from_spec(spec)
    pytest.importorskip("sphinx")
    spec.loader.exec_module(module)
    return module


def test_columns_end_where_their_rule_does(page):
    text = (
        "           gap  regret\n"
        "----  --------  ------\n"
        "asbi  .1 | .2     0.00\n"
        "nsbi       nan         \n"
        "a line that is no row of the table\n"
    )
    assert page.as_markdown(text).split("\n") == [
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


def test_each_section_shows_its_tables(page):
    text = (ROOT / "docs" / "benchmarks.md").read_text(encoding="utf-8")
    included = re.findall(r"{include} reference/api/results/(.+)", text)
    assert included == [
        page.file_of(t).name for t in re.findall("## (.+)", text) if t in page.TABLES
    ]
    assert {*included} == {page.file_of(title).name for title in page.TABLES}


# Every table of the documentation is printed from its committed rows


pytest.importorskip("sphinx")
PATH = Path(__file__).parents[2] / "docs" / "_ext" / "results.py"
SPEC = importlib.util.spec_from_file_location("results", PATH)
assert SPEC is not None
assert SPEC.loader is not None
results = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(results)


@pytest.mark.parametrize("title", results.TABLES)
def test_a_section_has_its_tables(title):
    text = results.tables(results.TABLES[title])
    assert text.count("```bash") == len(results.TABLES[title])

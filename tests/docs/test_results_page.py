"""What benchmarks print becomes tables of the site, from committed rows."""

import importlib.util
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


pytest.importorskip("sphinx")
SPEC = importlib.util.spec_from_file_location(
    "results", ROOT / "docs" / "_ext" / "results.py"
)
assert SPEC is not None
assert SPEC.loader is not None
page = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(page)


def test_each_section_shows_its_tables():
    text = (ROOT / "docs" / "benchmarks.md").read_text(encoding="utf-8")
    included = re.findall(r"{include} reference/api/results/(.+)", text)
    assert included == [
        page.file_of(t).name for t in re.findall("## (.+)", text) if t in page.TABLES
    ]
    assert {*included} == {page.file_of(title).name for title in page.TABLES}


@pytest.mark.parametrize("title", page.TABLES)
def test_a_section_has_its_tables(title):
    text = page.tables(page.TABLES[title])
    assert text.count("```bash") == len(page.TABLES[title])

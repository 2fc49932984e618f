"""What benchmarks print becomes tables of the site, from committed rows."""

import re

import pytest

from tests.docs import ROOT, extension

pytest.importorskip("sphinx")
page = extension("results")


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

"""Every table of the documentation is printed from its committed rows."""

import importlib.util
from pathlib import Path

import pytest

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

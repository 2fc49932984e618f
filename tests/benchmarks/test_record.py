"""The record of results: what is kept, and what counts as different."""

import pytest

from benchmarks.record.cases import cases, run
from benchmarks.record.run import FILE, read


def test_the_committed_record_is_of_these_cases():
    kept = {name.removeprefix("again ") for name in read(FILE)}
    assert kept == {*cases()}
    assert FILE.stat().st_size < 5_000_000


@pytest.mark.parametrize(
    "name", ["loop A clean 9000", "campaign linear_1_1 9000", "identify missing 9000"]
)
def test_a_case_of_each_sort_runs(name):
    found = run(cases()[name], 0)
    assert "error" not in found.words
    assert found.figures
    assert found.rows > 0

"""The record of results: what is kept, and what counts as different."""

import copy

import pytest

from benchmarks.record.cases import cases, run
from benchmarks.record.comparison import compared
from benchmarks.record.run import FILE, read, write

OLD = {
    "figures": {"mean 0": [1.0, 0.02], "P(drag)": [0.9, None], "log Z": [-812.0, 0.1]},
    "words": {"verdict": "drag"},
    "cpu_seconds": 2.0,
    "rows": 500,
}


def test_a_verdict_that_changes_is_told_with_old_and_new():
    new = copy.deepcopy(OLD) | {"words": {"verdict": "none"}, "cpu_seconds": 1.0}
    lines = [*compared({"loop A 9000": OLD}, {"loop A 9000": new})]
    assert lines[2] == "| loop A | 1 | 1 | 2, 1 | 500, 500 |"
    assert lines[-1] == "loop A 9000: verdict: drag -> none"


def test_results_are_read_as_they_were_written(tmp_path):
    path = tmp_path / "some.jsonl.gz"
    write({"loop A 9000": OLD}, path)
    first = path.read_bytes()
    assert read(path) == {"loop A 9000": OLD}
    write(read(path), path)
    assert path.read_bytes() == first
    assert read(tmp_path / "none.jsonl") == {}


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

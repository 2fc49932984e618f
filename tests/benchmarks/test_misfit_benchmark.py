"""The worlds with misfit: what they are made of, and how they are scored."""

import json

from benchmarks.misfit import run
from benchmarks.misfit.run import COLUMNS
from benchmarks.misfit.summary import summary


def test_a_case_is_run_once_and_its_row_is_whole(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(run, "RESULTS", tmp_path)
    for _ in range(2):
        run.run_kind("letters", "CE", 0, 1)
    (row,) = run.rows_of("letters", "CE")
    assert capsys.readouterr().out.count("letters_CE_from_0 0") == 1
    assert [*row] == COLUMNS
    assert not row["failure"]
    assert float(row["held_true"]) < float(row["held_bare"])
    assert json.loads(row["named"]) == json.loads(row["helps"])
    assert any("CE: right" in line for line in summary([row]))

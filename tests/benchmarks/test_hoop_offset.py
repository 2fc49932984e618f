"""Verdicts on the hoop by the prior of the offset: rows, and what runs are made of."""

import json

import pytest

from benchmarks.__main__ import main as run
from benchmarks.measured import hoop_offset
from benchmarks.measured.record_stages import said
from sbi_active.tasks.ball_and_hoop import make_prior  # pyright: ignore
from sbi_active.tasks.ball_and_hoop.model import OFFSET_SD  # pyright: ignore

ROW = {
    "verdict": "compression",
    "named": ["compression"],
    "helps": ["dead zone", "compression"],
    "after": {"one": 0.5, "other": 0.25},
    "cpu_seconds": 7.6,
}


def test_what_helps_beside_what_is_named_is_said():
    assert said(ROW) == "compression, dead zone helps"
    assert said({**ROW, "helps": ["compression"]}) == "compression"
    none = {**ROW, "verdict": "none", "named": [], "helps": []}
    assert said(none) == "none"


def test_rows_that_stand_in_the_results_are_printed_and_not_run(tmp_path, capsys):
    rows = {
        f"{sd:g} {every}": {"offset_sd": sd, "every": every, **ROW}
        for sd in hoop_offset.SDS
        for every in hoop_offset.EVERY
    }
    out = tmp_path / "rows.json"
    out.write_text(json.dumps(rows))
    assert (
        run(["measured.hoop_offset", "--data", str(tmp_path), "--out", str(out)]) == 0
    )
    printed = capsys.readouterr().out
    assert printed.count("| compression, dead zone helps | 0.500 / 0.250 | 8 |") == 9
    assert "| 0.05 | 0.3 |" in printed


def test_without_the_records_it_says_where_they_should_be(tmp_path, capsys):
    out = ["--out", str(tmp_path / "rows.json")]
    assert run(["measured.hoop_offset", "--data", str(tmp_path), *out]) == 2
    assert "expected a record in" in capsys.readouterr().err


def test_the_prior_of_the_offset_is_as_wide_as_asked():
    for sd in (OFFSET_SD, 0.3):
        draws = make_prior(offset_sd=sd).sample((4_000,))
        assert float(draws[:, 2].std()) == pytest.approx(sd, rel=0.05)

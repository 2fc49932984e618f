"""Fits of the hoop to some of its readings."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from benchmarks.measured.hoop_least_squares import run_pieces
from benchmarks.measured.hoop_samples import left_out, main, refit
from sbi_active.tasks.ball_and_hoop import make_effects  # pyright: ignore
from sbi_active.tasks.records import cut  # pyright: ignore
from tests.tasks.test_records import record

EFFECTS = [e for e in make_effects() if e.name == "compression"]
TRUTH = np.array([12.0, 0.9, 0.01, 0.4])


@pytest.mark.parametrize("step", [1, 10])
def test_a_fit_to_some_of_the_readings_finds_what_made_them(step):
    pieces = cut(record(0.1, (0.1, 0.9), 300), 60)
    x = run_pieces(torch.from_numpy(TRUTH)[None], pieces, EFFECTS)[0].numpy()
    pieces = replace(pieces, output=x)
    samples = np.arange(step - 1, 60, step)
    found = refit(pieces, EFFECTS, np.arange(len(pieces)), samples)
    assert found[:2] == pytest.approx(TRUTH[:2], rel=0.05)
    assert found[3] == pytest.approx(TRUTH[3], rel=0.05)
    assert left_out(pieces, EFFECTS, samples) < 0.1


def test_without_the_records_it_says_where_they_should_be(tmp_path, capsys):
    out = ["--out", str(tmp_path / "rows.json")]
    assert main(["--data", str(tmp_path), *out]) == 2
    assert "expected a record in" in capsys.readouterr().err

"""The benchmark of start states: what cases are, and how they are counted."""

import csv

import pytest
import torch

from benchmarks.__main__ import main as run
from benchmarks.misfit.start_states import COLUMNS, SENSOR, draw_case


@pytest.mark.parametrize("number", [0, 1, 2])
def test_a_case_is_the_same_machine_with_and_without_a_hidden_force(number):
    bare = draw_case(number, is_hidden=False)
    full = draw_case(number, is_hidden=True)
    assert torch.equal(bare.theta, full.theta)
    assert (bare.name, bare.phi) == (full.name, full.phi)
    assert bare.size == 0
    moved = float((full.trials.x - bare.trials.x).square().mean().sqrt()) / SENSOR
    assert full.size == pytest.approx(moved)
    assert 1 < full.size < 40
    assert full.trials.x.shape == (12, 30)


def row(case, hidden, **changes):
    parts = {"case": case, "hidden": hidden, "size": 3.0 * hidden, "true": "lag"}
    parts |= {"verdict": "lag", "chosen": "lag", "is_misfit": hidden, "ess": 60}
    parts |= {"cpu_seconds": 10, "simulations": 1000, "simulator_seconds": 5}
    parts |= {"ess_alone": 3, "not_printed": 2, "inside": 2, "intervals": 3}
    return {**parts, "dearest": "lag: 400", **changes}


def test_the_summary_counts_the_bars(tmp_path, capsys):
    rows = [row(0, 0), row(1, 0, ess=40, chosen="bias + lag", simulations=3000)]
    rows += [row(0, 1, chosen="bias")]
    path = tmp_path / "rows.csv"
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        writer.writerows(rows)
    run(["misfit.start_states", "--summary", "--out", str(path)])
    *_, bare, hidden = capsys.readouterr().out.splitlines()
    assert "| none | 40 | 0.500 (1/2)" in bare
    assert "| 4 of 16 | 10 (10) | 2,000 (3,000) | 1.000 (2/2)" in bare
    assert bare.count("0.667 (4/6)") == 1
    assert "| 3.0 to 3.0 sensor deviations | 60 | 1.000 (1/1)" in hidden
    assert "| 0.000 (0/1)" in hidden

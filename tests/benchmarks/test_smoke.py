"""One small run of each closed loop, and tables of what was named."""

import json

import torch

from benchmarks.__main__ import main as run
from benchmarks.criticism.cases import draw_case
from benchmarks.criticism.scores import COLUMNS, score_case
from benchmarks.criticism.worlds import get_world
from benchmarks.forces.machines import machine
from benchmarks.measured import hoop_offset
from benchmarks.measured.removals import removed, table
from tests.criticism.misfit.oscillator import EFFECTS, MODEL, PRIOR, trials


def test_a_strong_effect_of_world_a_is_named_and_lowers_the_error():
    world = get_world("A")
    cases = ((n, draw_case(world, "library", n)) for n in range(20))
    number, case = next(p for p in cases if p[1].truth.non_centrality > 100)
    row = score_case(case, number)
    assert {*row} <= {*COLUMNS}
    assert row["verdict"] != "none"
    assert float(row["rmse_after"]) < 0.5 * float(row["rmse_before"])


def test_what_is_removed_is_not_named_and_aliases_are_counted():
    torch.manual_seed(0)
    row = removed(MODEL, PRIOR, trials(lag=0.3, hidden=0.6), EFFECTS)
    assert row["named"] == ["lag"]
    assert row["share_said"]
    text = table(
        {"servo: load-dependent": row, "balls: blue_ball": {**row, "named": []}}
    )
    assert "Aliases named: 1 of 1 removals; the share left said in 1." in text
    assert "Aliases named: 0 of 1 removals; the share left said in 0." in text


def test_rows_that_stand_in_the_results_are_printed_and_not_run(tmp_path, capsys):
    row = {"verdict": "drag", "named": ["drag"], "helps": ["lag", "drag"]}
    row |= {"after": {"one": 0.5, "other": 0.25}, "cpu_seconds": 7.6}
    rows = {
        f"{sd:g} {every}": {"offset_sd": sd, "every": every, **row}
        for sd in hoop_offset.SDS
        for every in hoop_offset.EVERY
    }
    out = tmp_path / "rows.json"
    out.write_text(json.dumps(rows))
    run(["measured.hoop_offset", "--data", str(tmp_path), "--out", str(out)])
    assert capsys.readouterr().out.count("| drag, lag helps | 0.500 / 0.250 |") == 9


def test_forces_are_hidden_in_machines_that_move():
    own = machine("pendulum")
    generator = torch.Generator().manual_seed(0)
    theta, action = own.draw_theta(generator), own.draw_actions(4, generator)
    x = own.model.fn(theta.expand(4, -1), action)
    assert x.shape == (4, 20)
    assert x.isfinite().all()

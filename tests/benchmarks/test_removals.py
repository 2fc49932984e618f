"""What is named when the effect that is there was removed."""

import torch

from benchmarks.__main__ import main as run
from benchmarks.measured.removals import removed, table
from tests.criticism.misfit.oscillator import EFFECTS, MODEL, PRIOR, trials


def test_a_row_says_what_is_named_and_whether_the_share_left_is_told():
    torch.manual_seed(0)
    row = removed(MODEL, PRIOR, trials(lag=0.3, hidden=0.6), EFFECTS)
    assert row["verdict"] == "lag"
    assert row["named"] == ["lag"]
    assert row["share_said"]
    assert row["cause"]["lag"] > 0.5


def test_the_table_counts_aliases():
    row = {"trial_simulations": 1000, "cpu_seconds": 2.0, "share_said": True}
    row |= {"cause": {"viscous": 0.6}, "helps": ["viscous"]}
    rows = {
        "servo: load-dependent": row | {"verdict": "viscous", "named": ["viscous"]},
        "servo: viscous": row
        | {"verdict": "load-dependent", "named": ["load-dependent"]},
        "balls: blue_basketball": row | {"verdict": "unexplained", "named": []},
    }
    text = table(rows)
    assert "Aliases named: 1 of 2 removals; the share left said in 1." in text
    assert "Aliases named: 0 of 1 removals; the share left said in 0." in text
    assert "| blue basketball | unexplained, viscous helps | viscous 0.60 |" in text


def test_without_the_recordings_it_says_where_they_should_be(tmp_path, capsys):
    out = ["--out", str(tmp_path / "rows.json")]
    assert (
        run(["measured.removals", "--set", "balls", "--data", str(tmp_path), *out]) == 2
    )
    assert "as in --data DIR" in capsys.readouterr().err

import pandas as pd
from matplotlib import image

from sbi_active.cli import main

SMALL = ["--set", "num_simulations=200"]


def test_run_writes_table_and_figure(tmp_path, capsys):
    out = tmp_path / "a"
    words = ["run", "numerical", "--rounds", "2", "--out", str(out), *SMALL]
    assert main(words) == 0
    printed = capsys.readouterr().out
    assert "the truth: " in printed
    assert str(out / "loop.png") in printed
    assert len(pd.read_csv(out / "trials.csv")) == 2
    assert f"sbi-active ask {out / 'campaign'}" in printed
    assert image.imread(out / "loop.png").shape[1] == 1320  # of campaign.plot

import pandas as pd
import pytest
from matplotlib import image

from sbi_active.cli import main

SMALL, SECONDS = ["--simulations", "200"], ["seconds", "cpu_seconds"]


def test_run_writes_table_and_figure(tmp_path, capsys):
    frames = []
    for name, rounds in (("b", "1"), ("a", "2")):
        out = tmp_path / name
        words = ["run", "numerical", "--rounds", rounds, "--out", str(out), *SMALL]
        assert main(words) == 0
        frames.append(pd.read_csv(out / "trials.csv").drop(columns=SECONDS))
    printed = capsys.readouterr().out
    assert "the truth: " in printed
    assert str(out / "loop.png") in printed
    assert frames[0].equals(frames[1][:1])
    assert f"sbi-active ask {tmp_path / 'a' / 'campaign'}" in printed
    assert image.imread(out / "loop.png").shape[1] == 1320  # of campaign.plot


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (
            ["run", "numerical", "--option", "variant=x"],
            "'linear', 'sinh', 'square'; got 'x'",
        ),
        (
            ["run", "box_collision", "--option", 'noise="loud"'],
            "expected sd of real numbers; got 'loud'",
        ),
        (
            ["run", "box_collision", "--option", "target=3"],
            "expected target among 1, 2; got 3",
        ),
    ],
)
def test_bad_names_list_the_valid_ones(arguments, text, tmp_path, capsys):
    assert main([*arguments, "--out", str(tmp_path)]) == 2
    assert text in capsys.readouterr().err

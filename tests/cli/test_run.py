import sys

import pandas as pd
import pytest
import torch
from matplotlib import image

from sbi_active.campaign import Trial
from sbi_active.cli import main
from sbi_active.cli.run import reference_of
from sbi_active.tasks import get_task  # pyright: ignore

SMALL, SECONDS = ["--simulations", "200"], ["seconds", "cpu_seconds"]


def test_run_writes_table_and_figure(tmp_path, capsys):
    frames = []
    for name, rounds in (("b", "1"), ("a", "2")):
        out = tmp_path / name
        words = ["run", "numerical", "--rounds", rounds, "--out", str(out), *SMALL]
        assert main(words) == 0
        frames.append(pd.read_csv(out / "trials.csv").drop(columns=SECONDS))
    printed = capsys.readouterr().out
    assert "exact_information" in printed
    assert "the truth: " in printed
    assert str(out / "loop.png") in printed
    assert frames[0].equals(frames[1][:1])
    # The prior's gain at the best action, by the exact oracle, is 8.884.
    assert 8 < frames[0]["exact_information"][0] <= 8.885
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


def test_what_a_task_needs_is_named(monkeypatch, tmp_path, capsys):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    assert main(["run", "box_collision", "--out", str(tmp_path)]) == 2
    assert "pip install 'sbi-active[mujoco]'" in capsys.readouterr().err


def test_invalid_trials_count_in_the_exact_posterior():
    pytest.importorskip("mujoco")
    task = get_task("box_collision", reference_budget=600)
    before = reference_of(task, [])
    assert before.x.shape == (0, 3)
    fell = Trial(0, torch.tensor([8.0]), torch.full((3,), torch.nan), "invalid")
    missing = Trial(1, torch.tensor([1.0]), None, "missing")
    after = reference_of(task, [fell, missing])
    assert after.action.tolist() == [[8.0]]
    heavy_and_rough, light_and_smooth = torch.tensor([[0.9] * 3, [0.1] * 3])
    assert float(after.log_prob(heavy_and_rough)) == -torch.inf
    assert float(after.log_prob(light_and_smooth)) > 0


def test_data_elsewhere_are_named_by_an_option(tmp_path, capsys):
    arguments = ["run", "servo_pendulum", "--option", f"data={tmp_path}"]
    assert main([*arguments, "--out", str(tmp_path)]) == 2
    assert "as --option data=FOLDER" in capsys.readouterr().err

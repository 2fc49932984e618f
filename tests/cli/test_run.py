import json
import sys

import arviz as az
import pytest
import torch
from matplotlib import image

from sbi_active.campaign import Trial
from sbi_active.cli import main
from sbi_active.cli.run import _reference
from sbi_active.tasks import get_task  # pyright: ignore

SMALL = ["--simulations", "200", "--samples", "20", "--iterations", "30"]


@pytest.mark.parametrize("method", ["asbi", "nsbi"])
def test_run_writes_table_figure_and_results(method, tmp_path, capsys):
    out = tmp_path / "results"
    status = main(
        ["run", "numerical", "--method", method, "--rounds", "2", "--out", str(out)]
        + SMALL
    )
    assert status == 0
    printed = capsys.readouterr().out
    assert "exact EIG" in printed
    assert "gap to exact" in printed
    assert "the truth: " in printed
    assert str(out / "loop.png") in printed
    assert image.imread(out / "loop.png").shape[1] == 1320  # of campaign.plot
    result = json.loads((out / "result.json").read_text())
    assert [r["round"] for r in result["rounds"]] == [1, 2]
    first = result["rounds"][0]
    # The prior's gain at the chosen action, by the exact oracle: 8.884 is the largest.
    assert first["exact_eig"] + first["regret"] == pytest.approx(8.884, abs=2e-3)
    data = az.from_netcdf(str(out / "inference_data.nc"))
    assert data.observed_data.x.shape == (2, 1)


def test_same_seed_same_results(tmp_path):
    results = []
    for name in ("a", "b"):
        main(
            ["run", "numerical", "--rounds", "1", "--out", str(tmp_path / name), *SMALL]
        )
        result = json.loads((tmp_path / name / "result.json").read_text())["rounds"][0]
        results.append({k: v for k, v in result.items() if "seconds" not in k})
    assert results[0] == results[1]


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (
            ["run", "numerical", "--option", "variant=x"],
            "'linear', 'sinh', 'square'; got 'x'",
        ),
        (["run", "numerical", "--option", "variant"], "expected --option NAME=VALUE"),
        (
            ["run", "numerical", "--option", "target=2"],
            "expected options of 'numerical' among variant",
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
    before = _reference(task, [])
    assert before.x.shape == (0, 3)
    fell = Trial(0, torch.tensor([8.0]), torch.full((3,), torch.nan), "invalid")
    missing = Trial(1, torch.tensor([1.0]), None, "missing")
    after = _reference(task, [fell, missing])
    assert after.action.tolist() == [[8.0]]
    heavy_and_rough, light_and_smooth = torch.tensor([[0.9] * 3, [0.1] * 3])
    assert float(after.log_prob(heavy_and_rough)) == -torch.inf
    assert float(after.log_prob(light_and_smooth)) > 0


@pytest.mark.slow
def test_a_task_s_own_options(tmp_path, capsys):
    pytest.importorskip("mujoco")
    status = main(
        ["run", "box_collision", "--option", "target=2", "--option", "noise=0.01"]
        + ["--rounds", "1", "--out", str(tmp_path), *SMALL]
    )
    assert status == 0
    assert "cube_density" in capsys.readouterr().out
    result = json.loads((tmp_path / "result.json").read_text())
    assert result["options"] == ["target=2", "noise=0.01"]
    trial = result["rounds"][0]
    assert (trial["x"] == [None] * 3) == (trial["status"] == "invalid")


def test_data_elsewhere_are_named_by_an_option(tmp_path, capsys):
    arguments = ["run", "servo_pendulum", "--option", f"data={tmp_path}"]
    assert main([*arguments, "--out", str(tmp_path)]) == 2
    assert "as --option data=FOLDER" in capsys.readouterr().err

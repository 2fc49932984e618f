import json

import arviz as az
import pytest

from sbi_active.cli import main

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
    assert str(out / "loop.png") in printed
    assert (out / "loop.png").stat().st_size > 20_000
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
        (["run", "numerica"], "expected a task among 'numerical'"),
        (
            ["run", "numerical", "--method", "abc"],
            "expected method to be one of 'asbi'",
        ),
        (["run", "numerical", "--variant", "x"], "'linear', 'sinh', 'square'; got 'x'"),
        (["run", "numerical", "--rounds", "0"], "expected --rounds >= 1; got 0"),
    ],
)
def test_bad_names_list_the_valid_ones(arguments, text, tmp_path, capsys):
    assert main([*arguments, "--out", str(tmp_path)]) == 2
    assert text in capsys.readouterr().err

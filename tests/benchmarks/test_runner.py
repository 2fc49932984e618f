"""One command runs every benchmark, and README's table is what rows say."""

import json
import math
import re
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch

from benchmarks import table as readme
from benchmarks.__main__ import HERE, benchmarks, main, module_of, parser_of
from benchmarks.bits.run import FIGURES, figures, runs
from benchmarks.criticism.cases import draw_case
from benchmarks.criticism.scores import score_case
from benchmarks.criticism.worlds import get_world
from benchmarks.experiments.run import Reality
from benchmarks.forces.machines import machine
from benchmarks.location_finding import run as location
from benchmarks.measured.cascaded_tanks import fit_tanks, score
from benchmarks.measured.removals import removed, table
from benchmarks.misfit import cases as misfit_cases
from benchmarks.misfit.summary import summary
from benchmarks.robustness import run as robustness
from benchmarks.rows import benchmark, read
from benchmarks.search import run as search
from benchmarks.target import cart_pole as target
from sbi_active import GaussianNoise, SimulatorModel
from sbi_active.tasks import cascaded_tanks
from tests.criticism.misfit.oscillator import EFFECTS, MODEL, PRIOR, trials

ROOT = Path(__file__).parents[2]


def test_cases_are_run_once_and_those_that_are_asked_for_are_told(tmp_path, capsys):
    made = []

    def row(kind, seed):
        made.append((kind, seed))
        if seed == 3:
            raise ValueError("no")
        return {"value": 10.0 * seed, **({"extra": 1} if kind == "b" else {})}

    run = benchmark(
        tmp_path / "rows.csv",
        row,
        lambda rows: " ".join(f"{r['kind']}{r['seed']}" for r in rows),
        skip=lambda kind, seed: (kind, seed) == ("b", 2),
        may_fail=True,
        kind=("a", "b"),
        seed=range(1, 3),
    )
    parse = parser_of(run, "some").parse_args
    run(**vars(parse(["--summary"])))
    assert not made
    run(**vars(parse([])))
    assert made == [("a", 1), ("b", 1), ("a", 2)]  # ranges vary slowest
    capsys.readouterr()
    run(**vars(parse(["--seeds", "2", "4", "--kind", "a"])))
    assert made[3:] == [("a", 3)]
    assert capsys.readouterr().out.splitlines()[-1] == "a2 a3"
    rows = read(tmp_path / "rows.csv")
    assert [*rows[0]] == ["kind", "seed", "value", "extra", "failure"]
    assert rows[-1]["failure"] == "ValueError: no"
    assert (rows[1]["value"], rows[1]["extra"], rows[0]["extra"]) == ("10", "1", "")


@pytest.mark.parametrize("name", benchmarks())
def test_every_benchmark_has_a_parser_and_describes_its_options(name):
    try:
        run = import_module(module_of(name)).main
    except ImportError as error:
        pytest.skip(str(error))
    parser = parser_of(run, name)
    assert all(action.help for action in parser._actions)


def test_all_are_listed(capsys):
    assert main([]) == 0
    printed = capsys.readouterr().out
    assert {"oracles", "measured.go2", "table"} <= {*benchmarks()}
    for name, line in benchmarks().items():
        assert re.search(rf"^{re.escape(name)} +{re.escape(line)}$", printed, re.M)
        assert line, name


@pytest.mark.parametrize("words", [["search", "--wrong"], ["search", "--seeds", "a"]])
def test_a_wrong_option_ends_the_run(words, capsys):
    with pytest.raises(SystemExit) as ended:
        main(words)
    assert ended.value.code == 2
    assert "usage: python -m benchmarks search" in capsys.readouterr().err
    assert main(["serach"]) == 2


def test_every_command_that_is_written_down_names_a_benchmark():
    files = [ROOT / "README.md", *ROOT.glob("docs/**/*.md"), *HERE.rglob("*.py")]
    for path in files:
        if "_build" in path.parts or "api" in path.parts:
            continue
        text = path.read_text(encoding="utf-8")
        for name in re.findall(r"python -m\s+benchmarks ([a-z][\w.]*)", text):
            assert module_of(name), path
        for script in re.findall(r"python benchmarks/(\S+\.py)", text):
            assert "__main__" in (HERE / script).read_text(), (path, script)


# README's table is what committed rows say, and holds what is stated of it


def test_readme_shows_the_rows_and_no_value_is_missed():
    lines, misses = readme.table()
    assert "\n" + "\n".join(lines) + "\n\n" in (ROOT / "README.md").read_text()
    assert not misses


@pytest.mark.parametrize("way", ["least = { ratio = 1e3 }", "most = { ratio = 1 }"])
def test_a_missed_value_is_said_and_is_a_failure(tmp_path, monkeypatch, capsys, way):
    stated = tmp_path / "stated.toml"
    row = ("figures", "training"), ("what", "training"), ("result", "{ratio:.0f}")
    lines = [f'{key} = "{value}"' for key, value in (*row, ("beside", ""))]
    stated.write_text("\n".join(["[[row]]", *lines, way]))
    monkeypatch.setattr(readme.table, "__defaults__", (stated,))
    assert main(["table", "readme"]) == 1
    printed = capsys.readouterr()
    assert printed.out.endswith("| training | 43 | |\n")
    assert "training: expected ratio at" in printed.err


# One small run of each kind of benchmark, and what its table makes of the rows


RESULTS = Path(misfit_cases.__file__).parent / "results"
TANKS = Path(cascaded_tanks.DATA).resolve()


def test_a_last_bit_counts():
    x = torch.tensor([1.0, 2.0])
    other = torch.nextafter(x, torch.tensor([2.0, 2.0]))
    assert figures([x]) == figures([x.clone()])
    for different in ([other], [x.double()], [x, None], [x[None]]):
        assert figures(different)["digest"] != figures([x])["digest"]
    assert list(json.loads(FIGURES.read_text())["runs"]) == [name for name, _ in runs()]


def test_a_strong_effect_of_world_a_is_named_and_lowers_the_error():
    world = get_world("A")
    cases = ((n, draw_case(world, "library", n)) for n in range(20))
    number, case = next(p for p in cases if p[1].truth.non_centrality > 100)
    row = score_case(case, number)
    assert row["verdict"] != "none"
    assert float(row["rmse_after"]) < 0.5 * float(row["rmse_before"])


def test_a_case_of_misfit_is_run_once_and_its_row_is_whole(tmp_path, capsys):
    command = ["misfit", "--group", "letters", "--kind", "CE", "--cases", "0", "1"]
    for _ in range(2):
        main([*command, "--out", str(tmp_path / "{group}_{kind}.csv")])
    assert capsys.readouterr().out.count("letters_CE 0") == 1
    (row,) = read(tmp_path / "letters_CE.csv")
    (judged, *_) = read(RESULTS / "letters_CE.csv")
    assert {*row} <= {*judged}
    assert float(row["held_true"]) < float(row["held_bare"])
    assert any("CE: right" in line for line in summary([row]))


def test_the_truth_of_a_case_runs_the_trial_that_was_drawn():
    case = misfit_cases.draw_case("own", "E", 330)
    truth, reality = case.truth, Reality.of(330, "E", 1.0)
    reality.index = k = int(truth.fitted[-1])  # as if it were the next one
    x = reality.run(truth.action[k])
    assert torch.allclose(x, truth.measured(torch.tensor([k]))[0])
    assert reality.index == k + 1


def test_what_is_removed_is_not_named_and_aliases_are_counted():
    torch.manual_seed(0)
    row = removed(MODEL, PRIOR, trials(lag=0.3, hidden=0.6), EFFECTS)
    assert row["named"] == ["lag"]
    assert row["share_said"]
    rows = {"servo: load-dependent": row, "balls: blue_ball": {**row, "named": []}}
    for said in (1, 0):
        words = f"Aliases named: {said} of 1 removals; the share left said in {said}."
        assert words in table(rows)


def test_forces_are_hidden_in_machines_that_move():
    own = machine("pendulum")
    generator = torch.Generator().manual_seed(0)
    theta, action = own.draw_theta(generator), own.draw_actions(4, generator)
    x = own.model.fn(theta.expand(4, -1), action)
    assert x.shape == (4, 20)
    assert x.isfinite().all()


@pytest.mark.slow
@pytest.mark.skipif(not TANKS.is_dir(), reason=f"needs the records in {TANKS}")
def test_tanks_err_as_others_found():
    """Least squares by SciPy, with other integrators, found .290."""
    records = cascaded_tanks.read_recordings(TANKS)
    _, scored = cascaded_tanks.split(records)
    names = ("overflow", "linear outflow")
    fit, effects = fit_tanks(records["estimation"], names, starts=2)
    own = torch.from_numpy(fit.parameters[:-2])[None]
    assert score(own, scored, effects)["validation"] == pytest.approx(0.290, rel=0.1)


def test_intervals_of_robots_are_found_once_and_told(tmp_path, capsys):
    sysid = pytest.importorskip("mujoco.sysid")
    if not hasattr(sysid, "Parameter"):
        pytest.skip("needs mujoco.sysid; run pip install 'sbi-active[sysid]'")
    out = tmp_path / "coverage.csv"
    command = ["robots.coverage", "--seeds", "2000", "2001", "--machine", "spring-mass"]
    command += ["--condition", "friction 1", "--way", "sysid", "ours", "bare"]
    for _ in range(2):
        main([*command, "--out", str(out)])
        rows = pd.read_csv(out)
        assert {*rows.groupby("way").size()} == {2}
    inside = (rows.low <= rows.truth) & (rows.truth <= rows.high)
    assert inside[rows.way == "ours"].all()
    assert not inside[rows.way == "sysid"].any()
    assert "| friction 1 | 0.00 | 1.00 | 1.00 | - |" in capsys.readouterr().out


def test_an_effect_hidden_in_a_robot_shows_and_no_parameter_absorbs_it():
    pytest.importorskip("mujoco")
    from benchmarks.robots import hidden
    from benchmarks.robots.public import PUBLIC
    from sbi_active.mujoco import mjcf_effects

    robot, measured = hidden.planned(PUBLIC["servo"], np.random.default_rng(3))
    own = measured(np.zeros((hidden.NUM_TRIALS, hidden.NUM_READINGS, 1)))
    truth, effects = hidden.Truth(robot, own), mjcf_effects(robot, trials=own)
    theta, rng = 0.5 * (truth.low + truth.high).numpy(), np.random.default_rng(5)
    effect, phi, excess = hidden.hidden_effect(truth, effects, theta, rng)
    assert hidden.EXCESS[0] <= excess <= hidden.EXCESS[1]
    # Not refitted, the bare model is farther away.
    apart = truth.run(theta[None], effect, phi) - truth.run(theta[None])
    assert (apart**2).sum() >= excess * 0.999


def test_signals_are_chosen_for_the_worst_deviation():
    """Not the first, which tells most, unless another tells the rest after it."""
    pytest.importorskip("mujoco")
    from benchmarks.robots.excitation import nearest

    gain = torch.tensor([[100.0, 1.0], [3.0, 2.0], [1.0, 20.0]])
    simulator = SimulatorModel(
        lambda theta, a: theta * gain[a[:, 0].long()], noise=GaussianNoise(1.0)
    )
    draws = torch.randn(500, 2, generator=torch.Generator().manual_seed(0))
    belief = SimpleNamespace(draws=draws, quick_sample=lambda num, seed: draws[:num])
    robot: Any = SimpleNamespace(simulator=simulator)
    pool = torch.arange(3.0)[:, None]

    def chosen(num_left, *wanted):
        return int(nearest(robot, belief, pool, torch.tensor(wanted), num_left))

    # Deviations after one are (.01, .71), (.32, .45) and (.71, .05).
    assert chosen(1, 1.0, 1.0) == 1
    assert chosen(2, 1.0, 1.0) in (0, 2)
    assert chosen(1, 0.1, 10.0) == 0


def test_a_test_that_fails_was_not_survived(tmp_path, monkeypatch):
    text = "import pytest\n\n\n@pytest.mark.parametrize('k', [0, 1])\ndef test_even(k):"
    (tmp_path / "test_own.py").write_text(f"{text}\n    assert k % 2 == 0\n")
    monkeypatch.setattr(robustness, "ROOT", tmp_path)
    found = {row["case"]: row for row in robustness.by_tests(("test_*.py",))}
    assert (found["0"]["survived"], found["1"]["survived"]) == (True, False)
    assert found["0"]["attack"] == "test_own test_even"
    assert "assert" in found["1"]["answer"]


def test_a_search_comes_near_the_best_of_known_functions():
    row = search.run("mixed 1-D x 3", "gradient", 40)
    assert row["regret"] <= search.FOUND


def test_the_regulator_s_gains_cost_least():
    theta = torch.zeros(1, 8)
    best = target.gains(theta)
    others = best * (1 + 0.1 * torch.eye(4).double())
    least = target.cost(theta, best)
    assert (target.cost(theta.expand(4, -1), others) > least).all()
    assert float(least) < 100


# Location finding: bounds of the information against a closed form, and a roll-out


def test_a_roll_out_has_its_row_and_the_table_its_line(monkeypatch):
    monkeypatch.setattr(location, "NUM_CONTRASTIVE", 100)
    row = location.roll_out("fixed", 0, 1)
    assert row["places"] == "-1.10618 0.1085"
    assert row["spce"] <= math.log(101)
    text = location.table([{"policy": "fixed", "rollout": 0, "trials": 1, **row}])
    assert "fixed, optimized (1)" in text
    assert "Foster" not in text  # published for 30 trials

"""The worlds with misfit: what they are made of, and how they are scored."""

import csv
import json

import pytest
import torch

from benchmarks.misfit import run
from benchmarks.misfit.cases import draw_case
from benchmarks.misfit.discrepancies import draw_discrepancy
from benchmarks.misfit.machines import GROUPS, get_machine
from benchmarks.misfit.refit import least_squares
from benchmarks.misfit.scores import COLUMNS
from benchmarks.misfit.summary import summary
from benchmarks.misfit.truth import respond
from sbi_active.seeding import forked_generators

EVERY = [name for names in GROUPS.values() for name in names]


def rows_of(machine, num=40):
    with forked_generators(0, "rows"):
        return machine.prior.sample((num,)).double(), machine.draw_actions(num)


@pytest.mark.parametrize("name", EVERY)
def test_an_effect_vanishes_at_its_null_and_moves_x_beyond(name):
    machine = get_machine(name)
    theta, action = rows_of(machine)
    trial = torch.arange(len(theta))
    bare = respond(machine, theta, action, trial)
    assert bare.isfinite().all()
    for effect in machine.library:
        null = effect.null_phi(len(theta), finite=True)
        same = respond(machine, theta, action, trial, [effect], [null])
        torch.testing.assert_close(same, bare, msg=effect.name)
        with forked_generators(1):
            drawn = effect.sample(len(theta))
        moved = respond(machine, theta, action, trial, [effect], [drawn]) - bare
        assert moved.square().mean().sqrt() > 0.5 * machine.noise_sd, effect.name


@pytest.mark.parametrize(("group", "number"), [("own", 0), ("own", 1), ("letters", 1)])
def test_sizes_are_what_the_refitted_bare_model_leaves(group, number):
    truth = draw_case(group, "M", number).truth
    assert 2 <= truth.size <= 10
    assert truth.excess() == pytest.approx(truth.size, rel=0.35)
    assert draw_case(group, "C", number).truth.excess() < 1e-6
    (size,) = (only := draw_case(group, "CE", number).truth).sizes
    assert only.excess() == pytest.approx(size, rel=0.35)


def test_a_removed_effect_leaves_the_truth_as_it_is():
    declared, removed = (draw_case("own", kind, 1) for kind in ("E", "R"))
    torch.testing.assert_close(declared.problem.trials.x, removed.problem.trials.x)
    names = {e.name for e in declared.problem.effects}
    assert names - {e.name for e in removed.problem.effects} == {*removed.truth.names}


def test_judging_seeds_have_forms_that_tuning_seeds_lack():
    machine = get_machine("pendulum")
    _, action = rows_of(machine, 20)
    with forked_generators(0):
        known, fresh = (
            [draw_discrepancy(machine, action, is_judged=late) for _ in range(60)]
            for late in (False, True)
        )
    assert {d.kind for d in known} == {"process", "force", "wandering", "form"}
    names = [{d.detail for d in part if d.kind == "form"} for part in (known, fresh)]
    assert min(map(len, names)) >= 2
    assert not names[0] & names[1]
    assert any("rough" in d.detail for d in fresh)


def test_least_squares_finds_a_line_within_bounds():
    t = torch.linspace(0, 1, 30, dtype=torch.float64)
    target = torch.stack([2 + 3 * t, 2 - 3 * t])
    infinite = torch.full((2,), torch.inf, dtype=torch.float64)
    z, residual = least_squares(
        lambda z: z[:, :1] + z[:, 1:] * t,
        target,
        torch.zeros(2, 2, dtype=torch.float64),
        low=torch.tensor([-10.0, 0.0], dtype=torch.float64),
        high=infinite,
        scale=torch.ones(2, dtype=torch.float64),
        weak=infinite,
    )
    assert z[0].tolist() == pytest.approx([2.0, 3.0], rel=1e-5)
    assert z[1].tolist() == pytest.approx([0.5, 0.0])  # the slope stays at its edge
    assert residual[0].abs().max() < 1e-4


def test_a_case_is_run_once_and_its_row_is_whole(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(run, "RESULTS", tmp_path)
    for _ in range(2):
        run.run_kind("letters", "CE", 0, 1)
    (row,) = run.rows_of("letters", "CE")
    assert capsys.readouterr().out.count("letters CE 0") == 1
    assert [*row] == COLUMNS
    assert not row["failure"]
    assert float(row["held_true"]) < float(row["held_bare"])
    assert {*json.loads(row["cause"])} == {e.name for e in get_machine("A").library}
    assert any("CE: right" in line for line in summary([row]))


def scored(kind, true, cause, *, bare=4.0, full=1.0, helps=(), **more):
    row = dict.fromkeys(COLUMNS, "")
    return row | {
        "kind": kind,
        "machine": "spring",
        "true": json.dumps(true),
        "equivalent": json.dumps(true),
        "held_bare": str(bare),
        "held_true": str(full),
        "held_verdict": str(bare),
        "held_single": "3.0",
        "helps": json.dumps(helps),
        "instead": "{}",
        "cause": json.dumps(cause),
        "trial_simulations": "1",
        "cpu_seconds": "1",
        **more,
    }


def test_the_summary_counts_what_was_right(tmp_path):
    rows = [
        scored("E", ["drift"], {"drift": 0.95, "bias": 0.1}, theta_covered="3/4"),
        scored("E", ["drift"], {"drift": 0.2, "bias": 0.7}, helps=["drift"]),
        scored("E", ["drift"], {"drift": 0.7, "bias": 0.0}, full=2.8),
        scored("R", ["drift"], {"bias": 0.6}, helps=["bias"]),
        scored("P", ["lag", "bias"], {"lag": 0.9, "bias": 0.1}, helps=["lag", "bias"]),
        scored("C", [], {"bias": 0.0}),
    ]
    path = tmp_path / "rows.csv"
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        writer.writerows(rows)
    with path.open() as file:
        text = "\n".join(summary([*csv.DictReader(file)]))
    assert "| E, gain >= 50 %: right | 0.500 (1/2)" in text
    assert "| E, gain 20 to 50 %: right | 1.000 (1/1)" in text
    assert "| E: a wrong name | 0.333 (1/3)" in text
    assert "| R: any name | 1.000 (1/1)" in text
    assert "| P, where both matter: both | 0.000 (0/1)" in text
    assert text.count("1.000 (1/1) [0.207, 1.000] |") >= 3
    assert "intervals of theta with misfit: 0.750 (3/4)" in text
    assert "claims of 0.9 to 1: mean 0.93, right 1.000 (2/2)" in text
    own = [
        [0.05**2, 0.1**2, 0.8**2, 0.7**2, 0.3**2, 0],
        [0.6**2],
        [0.1**2, 0.9**2],
        [0],
    ]
    alike = sum(sum(squares) / len(squares) for squares in own) / len(own)
    assert f"over 10 effects; each kind counted alike: {alike:.3f}" in text

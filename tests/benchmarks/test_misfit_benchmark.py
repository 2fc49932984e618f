"""The worlds with misfit: what they are made of, and how they are scored."""

import json

import pytest
import torch

from benchmarks.misfit import run
from benchmarks.misfit.cases import draw_case
from benchmarks.misfit.machines import GROUPS, get_machine
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


def test_a_case_is_run_once_and_its_row_is_whole(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(run, "RESULTS", tmp_path)
    for _ in range(2):
        run.run_kind("letters", "CE", 0, 1)
    (row,) = run.rows_of("letters", "CE")
    assert capsys.readouterr().out.count("letters CE 0") == 1
    assert [*row] == COLUMNS
    assert not row["failure"]
    assert float(row["held_true"]) < float(row["held_bare"])
    assert json.loads(row["named"]) == json.loads(row["helps"])
    assert any("CE: right" in line for line in summary([row]))

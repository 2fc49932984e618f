"""World D: what it hides, what it declares, and outcomes that are missing."""

import pytest
import torch

from benchmarks.criticism.cases import draw_case
from benchmarks.criticism.worlds import get_world
from benchmarks.criticism.worlds.box import DECLARED, HIDDEN

pytest.importorskip("mujoco")


@pytest.fixture(scope="module")
def world():
    return get_world("D")


def test_each_effect_is_hidden_in_turn(world):
    names = [draw_case(world, "library", n).truth.names for n in range(8)]
    assert names == [(name,) for name in HIDDEN * 2]
    assert draw_case(world, "clean", 0).truth.names == ()
    declared = draw_case(world, "library", 0).problem.effects
    assert [effect.name for effect in declared] == [*DECLARED]


def test_priors_are_rescaled_but_for_the_bounded_one(world):
    narrow, wide = world.library(1.0), world.library(3.0)
    for a, b in zip(narrow, wide, strict=True):
        ratio = float(b.prior.stddev / a.prior.stddev)
        assert ratio == pytest.approx(1.0 if a.name == "restitution" else 3.0)


def test_most_trials_stay_on_the_table(world):
    cases = [draw_case(world, "clean", n) for n in range(12)]
    valid = torch.cat([case.problem.trials.valid for case in cases])
    # Of the prior, .01 to .27 leave the table; thetas of 12 cases scatter the share.
    assert 0.6 < valid.double().mean() < 1.0


def test_a_case_whose_cube_is_lost_at_most_speeds_is_drawn_again(world):
    case = draw_case(world, "library", 1)  # of the first draw one trial is valid
    assert int(case.problem.trials.fit.valid.sum()) >= 4
    longer = draw_case(world, "library", 1, num_trials=12)
    assert torch.equal(longer.truth.theta, case.truth.theta)


def test_a_missing_outcome_has_a_finite_residual(world):
    truth = draw_case(world, "clean", 0).truth
    light = torch.tensor([[0.0, 0.0, 0.05]]).double()
    target = truth.predict(truth.theta, (), truth.action, 0)[0]
    gone = truth.predict(light, (), truth.action, 0)[0]
    assert gone.isnan().any()
    residual = truth.residual(light, (), target)
    assert residual.isfinite().all()
    assert residual.abs().max() > 0

"""The worlds of the benchmark: their physics, equivalences, and what a case reveals."""

from dataclasses import fields

import numpy as np
import pytest
import torch
from sbi.utils import BoxUniform

from benchmarks.criticism import refit
from benchmarks.criticism.cases import (
    SUPPORTED,
    Problem,
    Truth,
    draw_case,
    extend,
    respond,
)
from benchmarks.criticism.equivalence import merged, true_name
from benchmarks.criticism.intervals import brier_score, reliability, wilson
from benchmarks.criticism.refit import residual_sum_of_squares
from benchmarks.criticism.worlds import get_world
from benchmarks.criticism.worlds.block import EDGE, GRAVITY, slide
from benchmarks.criticism.worlds.sliding_block import NOISE_SD, TIMES
from sbi_active.criticism import AugmentedSimulator


def exact_position(near: float, far: float, speed: float, time: float) -> float:
    """Constant deceleration in each zone."""
    v, sign = abs(speed), np.sign(speed)
    t = min(time, v / (near * GRAVITY))
    if v * t - 0.5 * near * GRAVITY * t**2 <= EDGE:
        return sign * (v * t - 0.5 * near * GRAVITY * t**2)
    at_edge = np.sqrt(v**2 - 2 * near * GRAVITY * EDGE)
    t = min(time - (v - at_edge) / (near * GRAVITY), at_edge / (far * GRAVITY))
    return sign * (EDGE + at_edge * t - 0.5 * far * GRAVITY * t**2)


def effect_of(world, name):
    every = [*world.effects, world.scatter, *world.outside]
    return next(e for e in every if e.name == name)


def mean_with(world, theta, action, name, phi, index=None):
    index = torch.arange(len(action)) if index is None else index
    effect = effect_of(world, name)
    strength = torch.tensor([[phi]], dtype=theta.dtype)
    return respond(world, theta, action, index, [effect], [strength])[0]


def test_the_block_follows_the_closed_form():
    rng = np.random.default_rng(0)
    theta = torch.tensor(rng.uniform(0.1, 0.5, (300, 2)))
    speed = torch.tensor(rng.choice([-1, 1], (300, 1)) * rng.uniform(1, 3, (300, 1)))
    x = slide(theta, speed, times=TIMES)
    exact = [
        [exact_position(*t.tolist(), float(v), time) for time in TIMES]
        for t, v in zip(theta, speed, strict=True)
    ]
    assert (x - torch.tensor(exact)).abs().max() < 0.15 * NOISE_SD


def test_the_block_is_continuous_in_its_parameters():
    """Crossing an edge one step earlier or later must not make x jump."""
    near = torch.linspace(0.2, 0.22, 2_001).double()
    theta = torch.stack([near, torch.full_like(near, 0.5)], -1)
    x = slide(theta, torch.full((2_001, 1), 2.0).double(), times=[2.0])[:, 0]
    steps = x.diff().abs()
    assert steps.max() < 3 * steps.median()


def test_the_block_rests_where_friction_holds_it_on_a_slope():
    theta = torch.full((1, 2), 0.3)
    x = slide(theta, torch.ones(1, 1), times=[1.5, 2.0], tilt=0.2)
    assert torch.equal(x[:, 0], x[:, 1])
    slips = slide(theta, torch.ones(1, 1), times=[1.5, 2.0], tilt=0.4)
    assert slips[0, 1] < slips[0, 0] - 0.1


def test_a_wall_throws_the_block_back():
    theta, speed = torch.full((1, 2), 0.1), torch.full((1, 1), 3.0)
    x = slide(theta, speed, times=[0.2, 2.0], wall=0.8)
    assert x[0, 1] < 0.8 < slide(theta, speed, times=[2.0]).item()


@pytest.mark.parametrize("name", ["A", "B", "C"])
def test_effects_vanish_at_their_nulls(name):
    world = get_world(name)
    theta, action = world.prior.sample((16,)), world.actions.sample((16,))
    model = AugmentedSimulator(world.model, [*world.effects, *world.outside])
    index = torch.arange(16.0)
    bare = world.model.mean(theta, action)
    for effect in model.effects:
        phi = {effect.name: effect.null_phi(16).to(theta.dtype)}
        x = model.evaluate(theta, phi, action, index=index)
        assert torch.allclose(x, bare, atol=1e-5 * float(bare.abs().max())), effect.name


@pytest.mark.parametrize("name", ["A", "B"])
def test_two_ways_of_applying_effects_agree(name):
    """The data's own way and the augmented simulator's are written apart."""
    world = get_world(name)
    torch.manual_seed(0)
    theta, action = world.prior.sample((8,)), world.actions.sample((8,))
    index = torch.arange(8)
    model = AugmentedSimulator(world.model, [*world.effects, world.scatter])
    for effect in model.effects:
        strength = effect.prior.sample((1,))
        x, sd = respond(world, theta, action, index, [effect], [strength])
        phi = {effect.name: strength.expand(8, -1)}
        again = model.evaluate(theta, phi, action, index=index)
        assert torch.allclose(x, again, rtol=1e-5)
        scale = model.noise_scale(phi, action, torch.ones(8, 1), index=index)
        assert torch.allclose(sd, world.noise_sd * scale.expand_as(sd))


def test_a_gain_of_world_a_is_a_change_of_theta():
    world = get_world("A")
    theta, action = torch.tensor([[-3.0, 1.0]]).expand(21, -1), world.actions.values
    x = mean_with(world, theta, action, "gain", 0.3)
    assert torch.allclose(x, world.model.mean(1.3 * theta, action), rtol=1e-5)


def test_an_action_offset_of_world_a_is_a_bias():
    world = get_world("A")
    theta = torch.tensor([[-3.0, 1.5]]).expand(21, -1)
    x = mean_with(world, theta, world.actions.values, "action offset", 0.4)
    shifted = theta * torch.tensor([np.exp(-0.4), 1.0]).float()
    other = mean_with(world, shifted, world.actions.values, "bias", 1.5 * 0.4)
    assert torch.allclose(x, other, rtol=1e-4, atol=1e-3)


def test_a_drift_of_world_a_is_a_bias_where_actions_are_sorted():
    world = get_world("A")
    theta, action = torch.tensor([[-3.0, 1.5]]).expand(21, -1), world.actions.values
    x = mean_with(world, theta, action, "drift", 0.8)
    # Index = 2 (xi + 5): a slope, which theta_2 takes up, and a constant.
    steeper = theta + torch.tensor([0.0, 1.6])
    other = mean_with(world, steeper, action, "bias", 8.0)
    assert torch.allclose(x, other, rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize(("one_way", "shown"), [(True, False), (False, True)])
def test_a_tilt_of_world_b_shows_only_when_pushed_both_ways(one_way, shown):
    world = get_world("B", one_way=one_way)
    action = world.actions.values
    theta = torch.tensor([[0.3, 0.2]]).expand(len(action), -1)
    x = mean_with(world, theta, action, "tilt", 0.05)
    steeper = theta * np.cos(0.0) + np.sin(0.05)
    bare = world.model.mean(steeper.float(), action)
    assert bool(((x - bare).abs() > NOISE_SD).any()) is shown
    assert (frozenset({"none", "tilt"}) in world.equivalences) is one_way


def test_errors_have_the_declared_deviation_and_the_drawn_correlation():
    world = get_world("C")
    case = next(
        c
        for c in (draw_case(world, "clean", i, num_trials=60) for i in range(50))
        if c.truth.correlation == 0.9
    )
    trials = case.problem.trials.fit
    bare = world.model.mean(case.truth.theta.expand(60, -1), trials.action.float())
    error = (trials.x - bare).numpy() / NOISE_SD
    # Var of the mean square of AR(1): 2 (1 + rho^2) / (1 - rho^2) / (60 * 50).
    square = np.sqrt(2 * (1 + 0.81) / (1 - 0.81) / 3_000)
    assert abs((error**2).mean() - 1) < 4 * square
    correlation = (error[:, 1:] * error[:, :-1]).mean() / (error**2).mean()
    assert abs(correlation - 0.9) < 4 * np.sqrt((1 - 0.81) / 3_000)


@pytest.mark.parametrize("name", ["A", "B"])
def test_the_loop_is_given_trials_and_no_truth(name):
    world = get_world(name)
    names = {"model", "prior", "trials", "effects", "actions"}
    assert {f.name for f in fields(Problem)} == names
    declared = [e.name for e in draw_case(world, "clean", 0).problem.effects]
    for kind in ("library", "pair", "outside"):
        problem = draw_case(world, kind, 1).problem
        assert [e.name for e in problem.effects] == declared


def test_what_is_removed_is_gone_with_its_equivalents():
    world = get_world("A")
    seen = set()
    for number in range(12):
        case = draw_case(world, "removed", number)
        (name,) = case.truth.names
        seen.add(name)
        gone = (
            {"bias", "action offset"} if name in ("bias", "action offset") else {name}
        )
        left = {e.name for e in case.problem.effects}
        assert left == {e.name for e in world.effects} - gone
    assert len(seen) > 3
    assert "gain" not in seen


def test_what_cannot_be_expressed_has_no_stand_in_left(monkeypatch):
    """Both cases have one truth, so that what some effects leave is fitted once."""
    left_by, known = Truth._left_by, {}

    def once(truth, effects):
        names = frozenset(effect.name for effect in effects)
        if names not in known:
            known[names] = left_by(truth, effects)
        return known[names]

    monkeypatch.setattr(Truth, "_left_by", once)
    monkeypatch.setattr(refit, "STARTS", 3)
    world = get_world("B")
    removed = draw_case(world, "removed", 6, num_trials=12)
    case = draw_case(world, "inexpressible", 6, num_trials=12)
    assert case.truth.names == removed.truth.names == ("viscous drag",)
    assert torch.equal(case.problem.trials.x, removed.problem.trials.x)
    left = {effect.name for effect in case.problem.effects}
    assert "quadratic drag" in {e.name for e in removed.problem.effects} - left
    assert removed.truth.left_by_any(removed.problem.effects) < SUPPORTED
    assert case.truth.left_by_any(case.problem.effects) > SUPPORTED


def test_a_case_is_its_number():
    world = get_world("B")
    first, again = draw_case(world, "library", 3), draw_case(world, "library", 3)
    assert torch.equal(first.problem.trials.x, again.problem.trials.x)
    longer = draw_case(world, "library", 3, num_trials=12)
    assert torch.equal(longer.problem.trials.x[:8], first.problem.trials.x[:8])
    other = draw_case(world, "library", 4)
    assert not torch.equal(other.truth.theta, first.truth.theta)
    assert len(first.problem.trials.held_out_positions) == 8


def test_a_further_trial_leaves_the_earlier_ones_alone():
    case = draw_case(get_world("B"), "library", 3)
    grown = extend(case, torch.tensor([3.0]))
    assert torch.equal(grown.problem.trials.x[:8], case.problem.trials.x[:8])
    assert grown.problem.trials.action[8].item() == 3.0


def test_non_centrality_is_weighted_least_squares_where_the_model_is_linear():
    world = get_world("A")
    case = next(
        c
        for c in (draw_case(world, "library", i) for i in range(60))
        if c.truth.names == ("drift",) and float(c.truth.theta.abs().max()) < 3
    )
    xi = case.truth.action.double()[:, 0]
    design = torch.stack([torch.exp(3 - xi), xi], -1)
    shift = case.truth.strengths[0].double() * torch.arange(8)
    left = shift.flatten() - design @ torch.linalg.lstsq(design, shift.T).solution[:, 0]
    assert case.truth.non_centrality == pytest.approx(float(left.square().sum()), 1e-4)


def test_wrong_priors_are_declared_and_the_truth_stays():
    world = get_world("B")
    right = draw_case(world, "library", 5)
    wrong = draw_case(world, "library", 5, prior_scale=3.0)
    assert torch.equal(right.problem.trials.x, wrong.problem.trials.x)
    for a, b in zip(right.problem.effects, wrong.problem.effects, strict=True):
        assert torch.allclose(b.prior.variance, 9 * a.prior.variance)


def test_equivalent_names_count_as_one():
    world = get_world("A")
    stated = {"none": 0.2, "gain": 0.1, "bias": 0.3, "action offset": 0.3, "drift": 0.1}
    total = merged(world, stated)
    assert [*total.values()] == pytest.approx([0.6, 0.3, 0.1])
    assert [*total][1:] == ["none", "drift"]
    assert true_name(world, "gain") == "none"
    assert true_name(world, "noise inflation") == "scatter"


def test_intervals_and_calibration():
    low, high = wilson(60, 60)
    assert high == pytest.approx(1.0)
    assert low == pytest.approx(1 - wilson(0, 60)[1])
    stated = [{"a": 0.8, "b": 0.2}, {"a": 0.8, "b": 0.2}]
    assert brier_score(stated, ["a", "b"]) == pytest.approx((0.08 + 1.28) / 2)
    assert reliability(stated, ["a", "b"])[-1][1:] == (0.5, 2)


def test_unknown_names_list_the_valid_ones():
    with pytest.raises(ValueError, match="expected a world among.*'B'.*got 'Z'"):
        get_world("Z")
    with pytest.raises(ValueError, match="expected a kind among.*'pair'.*got 'odd'"):
        draw_case(get_world("A"), "odd", 0)  # type: ignore[arg-type]


def test_a_rough_fit_needs_no_derivatives():
    """Steps of .01, between which a descent stays where it starts."""
    prior = BoxUniform(-5 * torch.ones(2), 5 * torch.ones(2))
    torch.manual_seed(0)
    starts = prior.sample((64,)).double()

    def residual(z):
        return 3 * (100 * z).round() / 100 - torch.tensor([6.0, -3.0])

    found = residual_sum_of_squares(residual, starts, prior=prior, is_rough=True)
    descended = residual_sum_of_squares(residual, starts, prior=prior)
    assert descended == float(residual(starts).square().sum(1).min())
    assert found < 0.1 * descended


def test_a_rough_fit_is_repeated_where_much_is_left():
    prior = BoxUniform(-torch.ones(1), torch.ones(1))
    torch.manual_seed(0)
    starts = prior.sample((16,)).double()
    rows = {}
    for left in (9.0, 11.0):
        count = []

        def residual(z, left=left, count=count):
            count.append(len(z))
            return torch.full((len(z), 1), left).double().sqrt() + 0.0 * z

        found = residual_sum_of_squares(residual, starts, prior=prior, is_rough=True)
        assert found == pytest.approx(left)
        rows[left] = sum(count)
    assert rows[11.0] == 4 * rows[9.0]

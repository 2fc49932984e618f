"""The worlds of the benchmark: their physics, equivalences, and what a case reveals."""

import numpy as np
import pytest
import torch
from sbi.utils import BoxUniform

from benchmarks.criticism.cases import (
    draw_case,
    respond,
)
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


def test_a_case_is_its_number():
    world = get_world("B")
    first, again = draw_case(world, "library", 3), draw_case(world, "library", 3)
    assert torch.equal(first.problem.trials.x, again.problem.trials.x)
    longer = draw_case(world, "library", 3, num_trials=12)
    assert torch.equal(longer.problem.trials.x[:8], first.problem.trials.x[:8])
    other = draw_case(world, "library", 4)
    assert not torch.equal(other.truth.theta, first.truth.theta)
    assert len(first.problem.trials.held_out_positions) == 8


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

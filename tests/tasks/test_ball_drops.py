"""Falling balls: the fall, what it may lack, and the measured drops."""

import numpy as np
import pytest
import torch

from benchmarks.measured.ball_forecast import forecast_error, second_drop_error
from sbi_active.criticism import AugmentedSimulator
from sbi_active.tasks import get_task  # pyright: ignore
from sbi_active.tasks.ball_drops import (  # pyright: ignore
    Drop,
    fall,
)

G, TIMES = 9.81, torch.linspace(0, 4, 61).double()
LEVEL = torch.zeros(1, 2).double()


def drop(strength, exponent=1.0, *, start=0.1, sd=0.0, seed=0, number=1) -> Drop:
    """Return a fall with drag, with independent errors."""
    times = torch.arange(52).double() / 15
    drag = torch.tensor([strength]).double()
    args = {"times": times[None], "start": start, "drag": drag, "exponent": exponent}
    heights = fall(LEVEL, torch.zeros(1, 1), **args)[0].numpy()
    noise = np.random.default_rng(seed).normal(size=52) * sd
    return Drop("ball", number, times.numpy(), heights + noise, 0.1)


@pytest.mark.parametrize("strength", [0.5, 3.0])
@pytest.mark.parametrize("exponent", [1.0, 2.0])
def test_the_fall_with_drag_is_the_closed_form(strength, exponent):
    s = (TIMES - 0.2).clamp(min=0)
    if exponent == 1.0:
        c = strength / 10
        way = G / c * s - G / c**2 * (1 - torch.exp(-c * s))
    else:
        k = strength / 100
        way = torch.log(torch.cosh((G * k) ** 0.5 * s)) / k
    drag = torch.tensor([strength]).double()
    args = {"times": TIMES[None], "start": 0.2, "drag": drag, "exponent": exponent}
    x = fall(LEVEL, torch.zeros(1, 1), **args)[0]
    assert float((x - (47 - way)).abs().max()) < 1e-4


def test_every_effect_vanishes_at_its_null_and_moves_x_elsewhere():
    task = get_task("ball_drops")
    theta, action = task.prior.sample((16,)), task.actions.values[:1].repeat(16, 1)
    model = AugmentedSimulator(task.simulator, task.effects(), check=(theta, action))
    bare = model.evaluate(theta, {}, action)
    for effect in task.effects():
        if effect.name == "wind":  # which the drag alone sees
            continue
        phi = effect.sample(16).to(theta.dtype)
        change = (model.evaluate(theta, {effect.name: phi}, action) - bare).abs()
        assert float(change.max()) > 0.01, effect.name


@pytest.mark.parametrize("kind", ["linear drag", "quadratic drag"])
def test_least_squares_given_the_effect_finds_it(kind):
    exponent = 1.0 if kind == "linear drag" else 2.0
    pair = drop(3.0, exponent), drop(3.0, exponent, start=0.2, number=2)
    assert second_drop_error(*pair, kind) < 1e-3
    assert forecast_error(*pair, kind, until=0.8) < 1e-2
    assert second_drop_error(*pair, "gravity alone") > 0.5


def test_the_drag_sees_the_air_that_moves():
    drag, wind = torch.tensor([2.0, 2.0, 2.0]).double(), torch.tensor([0.0, 1.0, -1.0])
    theta = LEVEL.repeat(3, 1)
    still, up, down = fall(
        theta, theta, times=TIMES[None], drag=drag, wind=wind.double()
    )
    assert (up[5:] > still[5:]).all()  # rising air holds the ball longer
    assert (down[5:] < still[5:]).all()
    bare = fall(theta, theta, times=TIMES[None], wind=wind.double())
    assert torch.equal(bare[0], bare[1])

"""Falling balls: the fall, what it may lack, and the measured drops."""

import pytest
import torch

from sbi_active.criticism import AugmentedSimulator
from sbi_active.tasks import get_task  # pyright: ignore
from sbi_active.tasks.ball_drops import fall  # pyright: ignore

G, TIMES = 9.81, torch.linspace(0, 4, 61).double()
LEVEL = torch.zeros(1, 2).double()


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

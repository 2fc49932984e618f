"""Records of one input and one output, and the two machines that have them."""

import numpy as np
import pytest
import torch

from sbi_active.tasks import ball_and_hoop, cascaded_tanks  # pyright: ignore
from sbi_active.tasks.ball_and_hoop import spin  # pyright: ignore
from sbi_active.tasks.cascaded_tanks import levels, start_levels  # pyright: ignore
from sbi_active.tasks.records import Record, cut  # pyright: ignore
from sbi_active.tasks.stepping import lagged  # pyright: ignore

HOOP = torch.tensor([[7.3, 0.8, 0.0]], dtype=torch.float64)
TANKS = torch.tensor([[0.05, 0.05, 0.05, 0.04]], dtype=torch.float64)
MACHINES = {
    "hoop": (spin, HOOP, ball_and_hoop.make_effects(), 0.1, (-0.9, 0.9)),
    "tanks": (
        levels,
        TANKS,
        [*cascaded_tanks.make_effects(), start_levels()],
        4.0,
        (0.5, 6.0),
    ),
}


def record(step, bounds, num=240):
    """Steps between the bounds, and a first output."""
    rng = np.random.default_rng(0)
    voltage = np.repeat(rng.uniform(*bounds, num // 20), 20)
    return Record("made", step, voltage, np.linspace(4.0, 11.0, num))


def run(name, num=1, **effects):
    fn, theta, _, step, bounds = MACHINES[name]
    pieces = cut(record(step, bounds), 120, every=4, slope=6 * (name == "tanks"))
    return fn(theta.expand(num * len(pieces), -1), **pieces.rows(num), **effects)


@pytest.mark.parametrize("name", [*MACHINES])
def test_effects_vanish_at_zero_and_have_a_slope_there(name):
    bare = run(name)
    assert bare.isfinite().all()
    for effect in MACHINES[name][2]:
        unit = effect.prior.stddev.double().expand(2, -1)
        sizes = []
        for share in (0.0, 1e-4, 1e-2):
            x = run(name, **effect.apply({}, share * unit, None, None))
            sizes.append(float((x - bare).norm()))
        assert sizes[0] == 0, effect.name
        assert sizes[2] > 0, effect.name
        assert sizes[1] == pytest.approx(sizes[2] / 100, rel=0.3), effect.name


def test_the_hoop_follows_the_linear_equation():
    voltage = torch.ones(1, 40)
    times = torch.linspace(0.1, 4.0, 40)
    x = spin(HOOP, torch.zeros(1, 2), inputs={"voltage": voltage}, times=times)
    exact = 7.3 / 0.8 * (1 - torch.exp(-0.8 * times))
    torch.testing.assert_close(x[0], exact.double(), atol=0.01, rtol=0)


def test_dry_friction_holds_the_hoop_and_never_turns_it_around():
    voltage = torch.full((1, 60), 0.05)
    times = torch.linspace(0.1, 6.0, 60)
    start = torch.tensor([[0.0, 0.0], [0.0, 2.0]], dtype=torch.float64)
    rows = {"inputs": {"voltage": voltage.expand(2, -1)}, "times": times}
    x = spin(HOOP.expand(2, -1), start, **rows, coulomb=1.0)
    assert x[0].abs().max() == 0
    assert (x[1].diff() <= 0).all()
    assert x[1].min() >= 0


def test_a_lag_is_exact_for_a_step_and_has_a_slope_below_a_step():
    drive = torch.cat([torch.zeros(1, 2), torch.ones(50, 2)]).double()
    steps = torch.tensor([5.0, 1e-3], dtype=torch.float64)
    x = lagged(drive, steps)
    ends = torch.arange(51, dtype=torch.float64)
    filled = 5 * (1 - torch.exp(-ends / 5))  # integral of what still lacks
    torch.testing.assert_close((drive - x)[:, 0].cumsum(0), filled)
    assert (drive - x)[1, 1] == pytest.approx(1e-3)


def test_tanks_keep_their_water():
    """What is pumped less what flows out is what is there, both areas alike."""
    theta = torch.tensor([[0.05, 0.05, 1e-9, 0.04]], dtype=torch.float64)
    voltage = torch.full((1, 100), 2.0)
    out = levels(
        theta,
        torch.tensor([[0.0, 1.0, 0.1]]),
        inputs={"voltage": voltage},
        times=torch.tensor([400.0]),
    )
    upper = 4.0  # (.1 / .05)^2, which makes the slope below; it sinks to 2.56
    for _ in range(40_000):
        upper += 0.01 * (0.08 - 0.05 * upper**0.5)
    assert float(out) == pytest.approx(1.0 + 400 * 0.08 - (upper - 4.0), rel=1e-4)

import numpy as np
import pytest
import torch

pytest.importorskip("pybullet")
from benchmarks.pouring.loop.emulator import (  # noqa: E402
    NUM_NUMBERS,
    SHIFTS,
    Emulator,
)
from benchmarks.pouring.loop.run import averaged  # noqa: E402
from benchmarks.pouring.loop.worlds import draw, get_world  # noqa: E402

NOISE = 0.3


@pytest.fixture(scope="module")
def known():
    """An emulator of numbers that are linear in parameters and effects."""
    world = get_world("cubes")
    rows = [draw(world, "cubes", k) for k in range(9)]
    theta = torch.cat([r.theta for r in rows])
    action = torch.cat([r.action for r in rows])
    effects = {
        name: np.concatenate([r.effects[name] for r in rows])
        for name in rows[0].effects
    }
    rng = np.random.default_rng(0)
    weight = rng.normal(size=(len(effects) + 3, NUM_NUMBERS))
    inputs = np.column_stack([theta.numpy(), *effects.values()])
    x = 10 + inputs @ weight + NOISE * rng.standard_normal((len(inputs), NUM_NUMBERS))
    moved = 0.01 * np.array(SHIFTS)[:, None] * np.ones(NUM_NUMBERS)
    return Emulator.fit(world, theta, action, effects, x[:, None] + moved), weight


def test_an_outcome_is_the_mean_of_the_pours_of_an_action():
    action = torch.tensor([[20.0, 0, 2]] * 4 + [[140.0, 0, 2]] * 4)
    x = torch.arange(16.0).reshape(8, 2)
    trials = averaged(action, x, ["fit", "fit", "held out", "held out"] * 2)
    assert len(trials) == 4
    fitted = trials.x[torch.tensor([r == "fit" for r in trials.role])]
    assert fitted.tolist() == [[1.0, 2.0], [9.0, 10.0]]


def test_the_emulator_knows_what_it_learned(known):
    emulator, weight = known
    action = emulator.world.actions[[1, 1, 1]]
    theta = torch.full((3, 3), 0.4)
    phi = np.array([0.0, 1.0, 0.0])
    x = emulator(theta, action, tilt=phi, camera_offset=np.array([0, 0, 0.01])).numpy()
    root = emulator.widened[1] * emulator.roots[1]
    place = 3 + [*emulator.scales].index("tilt")
    assert root @ (x[1] - x[0]) == pytest.approx(weight[place], abs=0.25)
    assert root @ (x[2] - x[0]) == pytest.approx(np.full(NUM_NUMBERS, 0.05), abs=1e-6)
    # What is left of a pour is of about unit size.
    assert 0.8 < np.sqrt((root**2).sum(1).mean()) / NOISE < 2

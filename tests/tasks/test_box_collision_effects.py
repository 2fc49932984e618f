from functools import partial

import pytest
import torch

from sbi_active import GaussianNoise, SimulatorModel
from sbi_active.criticism import AugmentedSimulator
from sbi_active.tasks import get_task  # pyright: ignore

pytest.importorskip("mujoco")
from sbi_active.tasks.box_collision.model import positions  # noqa: E402
from sbi_active.tasks.box_collision.scene import LocalScene  # noqa: E402

TASK = get_task("box_collision")
EFFECTS = {effect.name: effect for effect in TASK.effects()}

# Name: strength, and the sign of the shift of x (or y) at a low friction.
SIGNS = {
    "restitution": (0.7, 0, 1),
    "viscosity": (0.5, 0, -1),
    "air": (1.2, 0, -1),
    "tilt": (1.0, 0, 1),
    "speed gain": (-0.05, 0, -1),
    "speed offset": (0.3, 0, 1),
    "aim": (0.01, 1, -1),
    "center of mass": (0.01, 1, 1),
    "pusher friction": (0.3, 0, -1),
    "force": (0.3, 0, 1),
    "camera bias": (0.01, 0, 1),
    "camera scale": (0.02, 0, 1),
    "time stamp": (0.05, 0, 1),
}


def evaluate(name, phi, theta, action):
    simulator = AugmentedSimulator(TASK.simulator, [EFFECTS[name]])
    return simulator.evaluate(theta, {name: phi}, action)


@pytest.mark.parametrize("name", EFFECTS)
def test_moves_the_cube_as_it_should(name):
    strength, axis, sign = SIGNS[name]
    theta, action = torch.full((1, 3), 0.2), torch.tensor([[5.0]])
    wide = SimulatorModel(
        positions, noise=GaussianNoise(TASK.noise), setup=partial(LocalScene, edge=10.0)
    )
    simulator = AugmentedSimulator(wide, [EFFECTS[name]])
    x = simulator.evaluate(theta, {name: torch.full((1, 1), strength)}, action)
    shift = float((x - wide.mean(theta, action))[0, axis])
    assert sign * shift > TASK.noise  # a shift that one trial can show

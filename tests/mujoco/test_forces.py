"""Forces of the dictionary on the joints of an MJCF."""

import torch

from sbi_active.criticism import AugmentedSimulator, Trials
from sbi_active.mujoco import force_effects
from tests.mujoco.test_robot import pendulum


def test_a_force_moves_the_robot_and_none_does_not():
    robot = pendulum(parameters={"hinge.damping": (0.0, 0.1)})
    theta, action = torch.full((2, 1), 0.05), torch.full((2, 1), 0.8)
    bare = robot.simulator.mean(theta, action)
    trials = Trials(action, bare, sample_times=robot.simulator.sample_times)
    parts = robot.simulator, robot.prior, trials
    effects = force_effects(*parts, include="v|v| of hinge")
    model = AugmentedSimulator(robot.simulator, effects)
    phi = torch.tensor([[0.0], [1.0]])
    x = model.evaluate(theta, {"v|v| of hinge": phi}, action)
    assert torch.allclose(x[0], bare[0], atol=1e-9)
    assert (x[1] - bare[1]).abs().max() > 1e-3

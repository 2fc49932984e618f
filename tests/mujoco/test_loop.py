"""From an MJCF to a verdict."""

import pytest
import torch

from sbi_active.criticism import AugmentedSimulator, Trials, close_loop
from sbi_active.mujoco import mjcf_effects
from tests.mujoco.test_robot import pendulum


@pytest.mark.slow
@pytest.mark.parametrize(
    ("hidden", "phi"), [("hinge friction loss", 0.12), ("gravity tilt y", 0.1)]
)
def test_a_hidden_effect_of_a_pendulum_is_named(hidden, phi):
    robot = pendulum(parameters={"hinge.damping": (0.0, 0.1)})
    effects = mjcf_effects(
        robot,
        include=["hinge f*", "hinge q*", "hinge s*", "hinge b*", "bob*", "gravity*"],
        exclude=["*sensor*"],
    )
    action = torch.linspace(-1.4, 1.4, 5)[torch.tensor([2, 0, 4, 1, 3]), None]
    theta = torch.full((5, 1), 0.03)
    x = AugmentedSimulator(robot.simulator, effects).evaluate(
        theta, {hidden: torch.full((5, 1), phi)}, action
    )
    x = x + 0.01 * torch.randn(x.shape, generator=torch.Generator().manual_seed(1))
    trials = Trials(action, x, sample_times=robot.simulator.sample_times)
    report = close_loop(
        robot.simulator,
        robot.prior,
        trials,
        effects=effects,
        evaluate=False,
        plan=False,
    )
    alike = {report.verdict, *report.equivalent}
    assert hidden in alike
    assert report.probabilities["none"] < 0.01

"""Forces of the dictionary on the joints of an MJCF."""

import numpy as np
import pytest
import torch

from sbi_active.criticism import AugmentedSimulator, Trials
from sbi_active.mujoco import force_effects, from_mjcf

CART = """<mujoco><option timestep=".002"/><worldbody>
<body name="cart"><joint name="rail" type="slide" axis="1 0 0" damping=".5"/>
<geom type="box" size=".1 .1 .1" mass="2"/>
<body name="pole"><joint name="hinge" axis="0 1 0"/>
<geom type="capsule" fromto="0 0 0 0 0 -.5" size=".02" mass=".4"/></body></body>
</worldbody></mujoco>"""


@pytest.fixture(scope="module")
def cart():
    robot = from_mjcf(
        CART,
        {"rail.damping": (0.0, 1.0)},
        sensors=["rail", "hinge"],
        times=np.linspace(0.05, 0.5, 10),
        start={"hinge": 0.8},
        noise=1e-3,
    )
    x = robot.simulator.mean(torch.full((3, 1), 0.5), torch.zeros(3, 1))
    times = robot.simulator.sample_times
    return robot, Trials(torch.zeros(3, 1), x, sample_times=times)


def test_a_force_moves_the_robot_and_none_does_not(cart):
    robot, trials = cart
    effects = force_effects(
        robot.simulator, robot.prior, trials, include="v|v| of hinge"
    )
    model = AugmentedSimulator(robot.simulator, effects)
    theta, action = torch.full((2, 1), 0.5), torch.zeros(2, 1)
    phi = torch.tensor([[0.0], [1.0]])
    x = model.evaluate(theta, {"v|v| of hinge": phi}, action)
    bare = robot.simulator.mean(theta, action)
    assert torch.allclose(x[0], bare[0], atol=1e-9)
    assert (x[1] - bare[1]).abs().max() > 1e-3

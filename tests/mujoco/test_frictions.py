"""Dry friction that follows the state of its joint."""

import numpy as np
import pytest
import torch

from sbi_active import BoxActions
from sbi_active.criticism import AugmentedSimulator
from sbi_active.mujoco import from_mjcf, mjcf_effects
from sbi_active.mujoco.effects.changes import FrictionChange
from tests.mujoco.test_effects import under
from tests.mujoco.test_robot import pendulum

THETA = {"hinge.damping": (0.0, 0.1)}


@pytest.fixture(scope="module")
def robot():
    return pendulum(parameters=THETA)


@pytest.fixture(scope="module")
def effects(robot):
    wanted = ["hinge friction loss*", "hinge static friction"]
    return {e.name: e for e in mjcf_effects(robot, include=wanted)}


def run(robot, phi, angles, effects, damping=0.0):
    model = AugmentedSimulator(robot.simulator, effects)
    action = torch.tensor(angles, dtype=torch.float64)[:, None]
    theta = torch.full((len(action), 1), damping, dtype=torch.float64)
    given = {
        e.name: torch.tensor(p, dtype=torch.float64).expand(len(action), -1)
        for e, p in zip(effects, phi, strict=True)
    }
    return model.evaluate(theta, given, action).numpy()


def test_a_friction_that_follows_nothing_is_that_of_the_field(robot, effects):
    loss = effects["hinge friction loss"]
    same = FrictionChange(("hinge",), "speed", speed=1e12)  # of any speed
    follows = under("model", same)
    field = run(robot, [[0.2]], [1.0, -0.6], [loss])
    assert run(robot, [[0.2]], [1.0, -0.6], [follows]) == pytest.approx(field, abs=1e-9)
    # Two frictions of one joint add up.
    both = run(robot, [[0.15], [0.05]], [1.0, -0.6], [follows, loss])
    assert both == pytest.approx(field, abs=1e-9)


@pytest.mark.parametrize("seed", range(2))
def test_no_draw_of_any_friction_feeds_energy(robot, effects, seed):
    rng = np.random.default_rng(seed)
    angle = rng.uniform(-1.4, 1.4)
    for effect in effects.values():
        phi = effect.declared_draws()[seed].tolist()
        x = run(robot, [phi], [angle], [effect])[0]
        assert np.abs(x).max() <= abs(angle) + 1e-3, effect.name


def test_friction_by_load_grows_with_the_force_of_the_motor():
    cart = """<mujoco><option timestep=".002" integrator="implicitfast"/><worldbody>
      <body><joint name="rail" type="slide" axis="1 0 0"/><geom size=".1" mass="1"/>
      </body></worldbody><actuator><motor name="push" joint="rail"/></actuator>
      </mujoco>"""
    robot = from_mjcf(
        cart,
        {"rail.damping": (0.0, 0.1)},
        sensors=["rail"],
        actions=BoxActions([0.0], [4.0], names=["push"]),
        times=[0.5, 1.0],
        noise=0.01,
    )
    (effect,) = mjcf_effects(robot, include=["rail friction loss by load"])
    free = run(robot, [], [2.0, 4.0], [])
    held = run(robot, [[0.25]], [2.0, 4.0], [effect])
    # A quarter of the push is lost, however large it is.
    assert held / free == pytest.approx(0.75, abs=0.01)

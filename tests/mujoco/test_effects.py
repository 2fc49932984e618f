"""Effects enumerated from a model: names, nulls, and what they do."""

import numpy as np
import pytest
import torch

from benchmarks.robots.models import PENDULUM
from sbi_active import BoxActions
from sbi_active.criticism import AugmentedSimulator, Effect, Trials
from sbi_active.criticism.effects.effect import UnderKey
from sbi_active.mujoco import force_effects, from_mjcf, mjcf_effects
from sbi_active.mujoco.effects.changes import FrictionChange
from tests.mujoco.machines import BALL
from tests.mujoco.test_robot import pendulum


@pytest.fixture(scope="module")
def robot():
    return pendulum(parameters={"hinge.damping": (0.0, 0.1)})


@pytest.fixture(scope="module")
def effects(robot):
    return {effect.name: effect for effect in mjcf_effects(robot)}


def under(keyword, change):
    """Return an effect that is a change of the model, or a force."""
    return Effect(
        keyword,
        hook="dynamics",
        prior=torch.distributions.HalfNormal(torch.ones(1).double()),
        null=0.0,
        apply=UnderKey(keyword, change),
    )


def run(robot, phi, *, action=(1.0,), damping=0.03):
    """Return motions at some actions, each with the strengths of effects."""
    model = AugmentedSimulator(robot.simulator, [*phi])
    action = torch.tensor(action, dtype=torch.float64)[:, None]
    theta = torch.full((len(action), 1), damping, dtype=torch.float64)
    given = {e.name: torch.as_tensor(v, dtype=torch.float64) for e, v in phi.items()}
    given = {name: v.expand(len(action), -1) for name, v in given.items()}
    return model.evaluate(theta, given, action).numpy()


def test_parameters_and_what_changes_nothing_are_left_out(effects):
    assert "hinge viscous damping" not in effects  # a parameter of the model
    assert "bob center of mass y" not in effects  # along the axis
    assert not [name for name in effects if "contact" in name]


def test_every_effect_vanishes_at_its_null_and_moves_the_robot(robot, effects):
    theta = robot.prior.sample((4,)).double()
    action = robot.actions.sample((4,)).double()
    model = AugmentedSimulator(robot.simulator, [*effects.values()])
    bare = robot.simulator.mean(theta, action)
    for effect in effects.values():
        null = effect.null_phi(4)
        assert (model.evaluate(theta, {effect.name: null}, action) == bare).all()
        phi = effect.declared_draws()[:4]
        changed = model.evaluate(theta, {effect.name: phi}, action)
        assert changed.isfinite().all(), effect.name
        assert (changed - bare).abs().max() > 1e-9, effect.name


def test_fields_are_those_of_the_mjcf(robot, effects):
    def native(**attributes):
        text = " ".join(f'{k}="{v}"' for k, v in attributes.items())
        spec = PENDULUM.replace('damping="0.03"', f'damping="0.03" {text}')
        other = pendulum(spec, parameters={"hinge.damping": (0.0, 0.1)})
        theta = torch.full((1, 1), 0.03, dtype=torch.float64)
        return other.simulator.mean(theta, torch.ones(1, 1, dtype=torch.float64))

    for attribute, name in (
        ("frictionloss", "hinge friction loss"),
        ("stiffness", "hinge stiffness"),
        ("armature", "hinge armature"),
    ):
        x = run(robot, {effects[name]: [0.07]})
        assert x == pytest.approx(native(**{attribute: 0.07}).numpy(), abs=1e-12)


def test_contacts_are_offered_where_something_touches():
    robot = from_mjcf(
        BALL, {"ball.mass": (0.05, 0.2)}, times=np.arange(0.02, 0.8, 0.02)
    )
    assert robot.simulator.noise.sd == pytest.approx(0.001)  # as the sensor says
    found = mjcf_effects(robot, include=["*softness", "*restitution"])
    assert "contact restitution" in {e.name for e in found}
    (effect,) = (e for e in found if e.name == "contact restitution")
    model = AugmentedSimulator(robot.simulator, [effect])
    theta = torch.full((2, 1), 0.1, dtype=torch.float64)
    phi = torch.tensor([[0.0], [1.5]], dtype=torch.float64)
    x = model.evaluate(theta, {effect.name: phi}, torch.zeros(2, 1).double())
    bounce = x[:, 15:].amax(1)
    assert bounce[1] > bounce[0] + 0.01


@pytest.mark.parametrize("what", ["backlash", "series elasticity"])
def test_transmissions_grow_from_nothing_without_a_jump(robot, effects, what):
    effect = effects[f"hinge {what}"]
    least = effect.apply.key.least
    sizes = [0.0, 0.01 * least, 0.02 * least, 0.999 * least, 1.001 * least]
    x = run(robot, {effect: torch.tensor(sizes)[:, None]}, action=[1.0] * 5)
    moved = np.abs(x - x[0]).max(1)
    assert moved[2] == pytest.approx(2 * moved[1], rel=1e-6)
    assert np.abs(x[4] - x[3]).max() < 0.05 * moved[3]
    assert moved[3] > 1e-4


def thrown(start):
    """Return the friction's prior deviation of a light link on a strong drive."""
    mjcf = """<mujoco><option timestep=".002"/><worldbody><body>
    <joint name="hinge" axis="0 1 0" range="-.8 .8" limited="true"/>
    <geom type="capsule" fromto="0 0 0 0 0 -.5" size=".02" mass=".05"/></body>
    </worldbody><actuator><position name="drive" joint="hinge" kp="20" kv="1"/>
    </actuator></mujoco>"""
    made = from_mjcf(
        mjcf,
        {"hinge.damping": (0.0, 8.0)},
        inputs=["drive"],
        sensors=["hinge"],
        times=np.linspace(0.02, 2, 100),
        start={"hinge": start},
    )
    time = torch.linspace(0, 2, 201, dtype=torch.float64)
    trials = Trials(
        torch.zeros(2, 1),
        torch.zeros(2, 100, 1),
        sample_times=made.simulator.sample_times,
        inputs={"drive": 0.5 * torch.sin(3 * time).expand(2, -1)},
        input_times=time,
    )
    (effect,) = mjcf_effects(made, trials=trials, include="hinge friction loss")
    return float(effect.declared_draws().square().mean().sqrt())


def test_priors_do_not_follow_the_jolt_of_a_start_beyond_a_limit():
    """By plain root mean squares it is 3.4 times as wide."""
    assert thrown(2.5) < 2 * thrown(0.0)


def test_a_force_of_the_dictionary_moves_the_robot_and_none_does_not(robot):
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


# Dry friction that follows the state of its joint


def test_a_friction_that_follows_nothing_is_that_of_the_field(robot, effects):
    loss, start = effects["hinge friction loss"], {"action": [1.0, -0.6]}
    same = FrictionChange(("hinge",), "speed", speed=1e12)  # of any speed
    follows = under("model", same)
    field = run(robot, {loss: [0.2]}, **start)
    assert run(robot, {follows: [0.2]}, **start) == pytest.approx(field, abs=1e-9)
    # Two frictions of one joint add up.
    both = run(robot, {follows: [0.15], loss: [0.05]}, **start)
    assert both == pytest.approx(field, abs=1e-9)


@pytest.mark.parametrize("seed", range(2))
def test_no_draw_of_any_friction_feeds_energy(robot, effects, seed):
    rng = np.random.default_rng(seed)
    angle = rng.uniform(-1.4, 1.4)
    frictions = [e for name, e in effects.items() if "friction" in name]
    assert len(frictions) == 3
    for effect in frictions:
        phi = effect.declared_draws()[seed]
        x = run(robot, {effect: phi}, action=[angle], damping=0.0)[0]
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
        actions=BoxActions([-4.0], [4.0], names=["push"]),
        times=[0.5, 1.0],
        noise=0.01,
    )
    (effect,) = mjcf_effects(robot, include=["rail friction loss by load"])
    push = {"action": [-2.0, 4.0], "damping": 0.0}
    free, held = run(robot, {}, **push), run(robot, {effect: [0.25]}, **push)
    # A quarter of the push is lost, however large it is.
    assert held / free == pytest.approx(0.75, abs=0.01)

"""Actions that keep a robot within its limits, and those that do not."""

import numpy as np
import pytest
import torch

from benchmarks.robots.models import ARM, PENDULUM
from sbi_active import BoxActions, DiscreteActions
from sbi_active.actions import MixedActions, SignalActions
from sbi_active.actions.waveforms import chirp, together
from sbi_active.mujoco import MotionLimits, from_mjcf
from tests.mujoco.machines import GAINS, held_arm, stepped

TIMES = torch.arange(0, 1.0, 0.01, dtype=torch.float64)
SIGNALS = SignalActions(
    together(
        chirp("shoulder servo", start_frequency=0.5),
        chirp("elbow servo", amplitude=0.2, start_frequency=0.5, end_frequency=2.0),
    ),
    [0.05, 1.0],
    [1.5, 4.0],
    input_times=TIMES,
)
LOAD = (
    '<body name="load" pos=".3 0 0"><geom size=".03" mass=".5"/></body></body></body>'
)


def arm(**options):
    given = {
        "parameters": {"shoulder.damping": (0.05, 0.5), "lower.mass": (0.3, 1.0)},
        "sensors": ["shoulder", "elbow"],
        "noise": 0.001,
        "inputs": SIGNALS,
    }
    return from_mjcf(options.pop("spec", ARM), **{**given, **options})


def test_limits_are_those_of_the_motion_itself():
    robot = arm()
    action = torch.tensor([[0.1, 2.0], [1.2, 3.0]])
    limits = MotionLimits(
        robot,
        position={"shoulder": (-0.6, 0.6)},
        velocity={"elbow": 20.0},
        torque={"shoulder servo": 200.0},
        num_draws=3,
    )
    assert limits(action).tolist() == [True, False]
    reached = limits.extremes(action)
    assert [*reached] == ["shoulder", "elbow velocity", "shoulder servo torque"]
    # What the sensors read at the same parameters.
    theta = limits._theta.repeat(2, 1)
    x = robot.simulator.mean(theta, action.double().repeat_interleave(3, 0))
    shoulder = x[..., 0].reshape(2, -1)
    low, high = reached["shoulder"]
    assert np.allclose(low, shoulder.min(1).values, atol=2e-3)
    assert np.allclose(high, shoulder.max(1).values, atol=2e-3)


def test_ranges_of_the_mjcf_are_the_default():
    limited = ARM.replace('axis="0 1 0" damping', 'axis="0 1 0" range="-20 20" damping')
    limited = "<mujoco>" + limited.split(">", 1)[1]
    robot = arm(spec=limited.replace("<option", '<compiler angle="degree"/><option'))
    limits = MotionLimits(robot)
    assert [*limits.extremes(torch.tensor([[0.1, 1.0]]))] == ["shoulder", "elbow"]
    assert limits(torch.tensor([[0.1, 1.0], [1.5, 2.0]])).tolist() == [True, False]


def test_a_state_that_diverges_is_refused():
    explicit = PENDULUM.replace("implicitfast", "Euler").replace("0.01", "0.05", 1)
    robot = from_mjcf(
        explicit,
        {"hinge.stiffness": (1e6, 2e6)},  # far beyond what the step can follow
        actions=DiscreteActions([[0.0], [1.0]], names=["hinge"]),
        times=[20.0],
        noise=0.01,
    )
    limits = MotionLimits(robot, position={"hinge": (-1e300, 1e300)})
    action = torch.tensor([[0.0], [1.0]])
    assert np.isnan(limits.extremes(action)["hinge"][0]).tolist() == [False, True]
    assert limits(action).tolist() == [True, False]


def test_limits_are_those_of_every_payload_that_an_action_chooses():
    payload = ARM.replace("</body>\n    </body>", LOAD)
    assert payload != ARM
    robot = arm(
        spec=[ARM, payload], actions=DiscreteActions([0.0, 1.0], names=["model"])
    )
    assert isinstance(robot.actions, MixedActions)
    assert robot.actions.names[-1] == "model"
    action = torch.tensor([[0.5, 2.0, 0.0], [0.5, 2.0, 1.0]])
    x = robot.simulator.mean(torch.tensor([[0.1, 0.5]]).expand(2, -1), action)
    assert float((x[0] - x[1]).abs().max()) > 0.01
    limits = MotionLimits(robot, position={"shoulder": (-0.6, 0.6)}, num_draws=2)
    assert {*limits(robot.actions.sample((12,), seed=0)).tolist()} == {True, False}
    with pytest.raises(ValueError, match="elbow servo|shoulder"):
        arm(actions=BoxActions(-1.0, 1.0, names=["elbow servo"]))


# What a motion starts from: keyframes, and what a name sets


TENDON = """<mujoco><option timestep="0.002"/><worldbody>
<body><joint name="hinge" axis="0 1 0" damping="0.1"/>
<geom type="capsule" fromto="0 0 0 0.4 0 0" size="0.02"/>
<body pos="0.4 0 0"><joint name="slide" type="slide" axis="1 0 0" damping="1"/>
<geom size="0.05"/></body></body></worldbody>
<tendon><fixed name="strap" stiffness="1" damping="0.2" springlength="0.1">
<joint joint="hinge" coef="0.5"/><joint joint="slide" coef="-1"/></fixed></tendon>
<actuator><general name="motor" tendon="strap" dyntype="filter" dynprm="0.1"
gainprm="3"/></actuator>
<sensor><jointpos joint="hinge"/><tendonpos tendon="strap"/>
<actuatorfrc actuator="motor"/></sensor>
<keyframe><key name="wound" qpos="0.3 -0.1" qvel="0 0.2" act="0.6"/></keyframe>
</mujoco>"""


@pytest.mark.parametrize("integrator", ["Euler", "RK4", "implicit", "implicitfast"])
@pytest.mark.parametrize("kind", GAINS)
def test_rows_of_a_held_arm_are_those_of_a_bare_loop(kind, integrator):
    """Keyframe, mocap body, equality, held control; every servo and integrator."""
    text = held_arm("drive", kind, integrator)
    robot = from_mjcf(
        text,
        {"hinge.damping": (0.0, 1.0)},
        actions=BoxActions([-1.0], [1.0], names=["drive"]),
        times=np.linspace(0.05, 0.5, 10),
        start="home",
        noise=0.01,
    )
    theta = torch.tensor([[0.1], [0.4], [0.9]], dtype=torch.float64)
    action = torch.tensor([[0.7], [-0.2], [0.4]], dtype=torch.float64)
    x = robot.simulator.mean(theta, action)
    for row in range(3):
        given = {"dof_damping": theta[row], "control": action[row]}
        angles = stepped(text, 251, key=True, **given)[25::25, 0]
        assert x[row].numpy() == pytest.approx(angles, abs=1e-12)
    assert float((x[0] - x[1]).abs().max()) > 1e-6


def test_a_start_is_a_keyframe_or_what_names_set():
    named = {"hinge": 0.7, "hinge velocity": -1.0, "servo control": 0.6}
    named |= {"hand mocap[0]": 0.3, "hand mocap[2]": 0.2}
    arm = held_arm("servo"), {"hinge.damping": (0.0, 1.0)}
    for start, key in (("home", True), (named, True), (None, False)):
        robot = from_mjcf(*arm, times=[0.0, 0.5], noise=0.01, start=start)
        x = robot.simulator.mean(torch.tensor([[0.1]]).double(), torch.zeros(1, 1))
        angles = stepped(arm[0], 251, key=key, dof_damping=0.1)[[0, 250], 0]
        assert x[0].tolist() == pytest.approx(angles, abs=1e-12)


def test_tendons_and_activations_move_as_in_a_bare_loop():
    robot = from_mjcf(
        TENDON,
        {"strap.stiffness": (0.0, 5.0), "motor.timeconst": (0.05, 0.5)},
        actions=BoxActions([-1.0], [1.0], names=["motor control"]),
        times=np.linspace(0.1, 1.0, 10),
        noise=0.01,
        start="wound",
    )
    assert robot.prior.units == ("", "s")
    theta = torch.tensor([[2.0, 0.3], [0.5, 0.1]], dtype=torch.float64)
    action = torch.tensor([[0.8], [-0.4]], dtype=torch.float64)
    x = robot.simulator.mean(theta, action).reshape(2, 10, 3)
    for row, (stiffness, time_constant) in enumerate(theta.tolist()):
        given = {"tendon_stiffness": stiffness, "actuator_dynprm": time_constant}
        rows = stepped(TENDON, 501, key=True, control=action[row], **given)
        assert x[row].numpy() == pytest.approx(rows[50::50], abs=1e-12)
    assert float((x[0] - x[1]).abs().min()) > 1e-3

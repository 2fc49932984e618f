"""What a motion starts from: keyframes, and what a name sets."""

import numpy as np
import pytest
import torch

from sbi_active import BoxActions
from sbi_active.mujoco import from_mjcf
from tests.mujoco.machines import GAINS, held_arm, stepped

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


def held(name: str, **options) -> list[float]:
    robot = from_mjcf(
        held_arm(name),
        {"hinge.damping": (0.0, 1.0)},
        **{"times": [0.0, 0.5], "noise": 0.01, **options},
    )
    value = torch.tensor([[0.2]], dtype=torch.float64)
    return robot.simulator.mean(torch.tensor([[0.1]]).double(), value)[0].tolist()


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


def test_a_keyframe_gives_controls_and_mocap_poses_too():
    x = held("servo", start="home")
    for key, own in ((True, x), (False, held("servo"))):
        angles = stepped(held_arm("servo"), 251, key=key, dof_damping=0.1)[[0, 250], 0]
        assert own == pytest.approx(angles, abs=1e-12)
    start = {"hinge": 0.7, "hinge velocity": -1.0, "servo control": 0.6}
    start |= {"hand mocap[0]": 0.3, "hand mocap[2]": 0.2}
    assert held("servo", start=start) == pytest.approx(x, abs=1e-12)


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

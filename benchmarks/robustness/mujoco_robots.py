"""Robots from MJCF beside a bare loop of mj_step: names, starts, fields and times."""

from __future__ import annotations

from typing import Any

import mujoco as _mujoco
import numpy as np
import torch

from benchmarks.robots.models import ARM, CART_POLE, PENDULUM, SPRING_MASS
from benchmarks.robustness.attacks import Attacks
from sbi_active import BoxActions
from sbi_active.mujoco import from_mjcf

ATTACKS = Attacks()
mujoco: Any = _mujoco  # its names are made at run time

HELD = """<mujoco><option timestep=".002" integrator="{integrator}"/>
  <worldbody>
    <body name="hand" mocap="true" pos="0 0 1"/>
    <body name="arm"><joint name="hinge" axis="0 1 0" damping=".1"/>
      <geom type="capsule" fromto="0 0 0 .5 0 0" size=".02" mass="1"/></body>
  </worldbody>
  <actuator><{kind} name="{name}" joint="hinge" {gain}/></actuator>
  <equality><connect body1="arm" body2="hand" anchor=".5 0 0"/></equality>
  <sensor><jointpos name="angle" joint="hinge"/></sensor>
  <keyframe><key name="home" qpos=".7" qvel="-1" ctrl=".6" mpos=".3 0 .2"/></keyframe>
</mujoco>"""
GAINS = {"position": 'kp="50"', "velocity": 'kv="2"', "motor": 'gear="3"'}


def held_arm(name: str, kind: str = "position", integrator: str = "Euler") -> str:
    """Return an arm that an equality holds, with an actuator of a name and kind."""
    return HELD.format(name=name, kind=kind, gain=GAINS[kind], integrator=integrator)


def mean(xml: str, theta: list[float], action: list[float], **options: Any) -> Any:
    """Return what the library simulates without noise, shape (num_outputs,)."""
    given = {"times": [0.0, 0.1, 0.5], "noise": 0.01, **options}
    robot = from_mjcf(xml, **given)
    values = [torch.tensor([row], dtype=torch.float64) for row in (theta, action)]
    return robot.simulator.mean(*values)[0].numpy()


def by_hand(
    model: Any, times: list[float], *, key: bool = False, **start: Any
) -> np.ndarray:
    """Return the sensors at times by stepping a model, shape (num_sensors * times,)."""
    data = mujoco.MjData(model)
    if key:
        mujoco.mj_resetDataKeyframe(model, data, 0)
    for field, value in start.items():
        values = np.atleast_1d(value)
        getattr(data, field)[: len(values)] = values
    rows = []
    for time in times:
        while data.time < time - 1e-9:
            mujoco.mj_step(model, data)
        mujoco.mj_forward(model, data)
        rows.append(data.sensordata.copy())
    return np.array(rows).T.ravel()


TIMES = [0.0, 0.1, 0.5]
DAMPING = {"hinge.damping": (0.0, 1.0)}


def arm(xml: str, damping: float = 0.1) -> Any:
    """Return the compiled model with a joint's damping."""
    model = mujoco.MjModel.from_xml_string(xml)
    model.dof_damping[0] = damping
    return model


@ATTACKS.add(
    "a start of the keyframe",
    cases=[
        (kind, integrator)
        for kind in GAINS
        for integrator in ("Euler", "implicitfast", "RK4")
    ],
)
def keyframe(case: tuple[str, str]) -> None:
    xml = held_arm("servo", *case)
    x = mean(xml, [0.1], [0.2], parameters=DAMPING, start="home")
    assert np.allclose(x, by_hand(arm(xml), TIMES, key=True), atol=1e-12), x


@ATTACKS.add(
    "an action by name",
    cases=[
        (name, called, kind)
        for kind in GAINS
        for name in ("servo", "hinge")
        for called in ("{} control", "{}", "hinge position", "hinge velocity")
    ],
)
def action(case: tuple[str, str, str]) -> None:
    name, called, kind = case
    called = called.format(name)
    xml = held_arm(name, kind)
    field = {"hinge position": "qpos", "hinge velocity": "qvel"}.get(called, "ctrl")
    x = mean(
        xml,
        [0.1],
        [0.2],
        parameters=DAMPING,
        start="home",
        actions=BoxActions([0.1], [0.3], names=[called]),
    )
    model = arm(xml)
    expected = by_hand(model, TIMES, key=True, **{field: 0.2})
    assert np.allclose(x, expected, atol=1e-12), (x, expected)


@ATTACKS.add("a damping beside the MJCF's own", cases=(0.0, 1e-6, 0.3, 2.0))
def damping(value: float) -> None:
    xml = held_arm("servo", "position")
    x = mean(xml, [value], [0.2], parameters={"hinge.damping": (0.0, 3.0)})
    assert np.allclose(x, by_hand(arm(xml, value), TIMES), atol=1e-12), x


@ATTACKS.add("a mass with its inertia", cases=(0.2, 1.0, 5.0))
def mass(value: float) -> None:
    robot = from_mjcf(
        PENDULUM,
        {"bob.mass": (0.1, 6.0)},
        sensors=["hinge"],
        actions=BoxActions([-1.5], [1.5], names=["hinge"]),
        times=[0.5, 1.0],
        noise=0.01,
    )
    values = [torch.tensor([[v]], dtype=torch.float64) for v in (value, 0.7)]
    x = robot.simulator.mean(*values)[0].numpy()
    model = mujoco.MjModel.from_xml_string(
        PENDULUM.replace('mass="1"', f'mass="{value!r}"')
    )
    data = mujoco.MjData(model)
    data.qpos[0] = 0.7
    angles = []
    for time in (0.5, 1.0):
        while data.time < time - 1e-9:
            mujoco.mj_step(model, data)
        angles.append(data.qpos[0])
    assert np.allclose(x, angles, atol=1e-12), (x, angles)


@ATTACKS.add("rows do not depend on threads or batches", cases=(1, 2, 7))
def threads(num: int) -> None:
    xml = held_arm("servo", "position")
    theta = torch.linspace(0, 1, 20, dtype=torch.float64)[:, None]
    action = torch.linspace(-0.5, 0.5, 20, dtype=torch.float64)[:, None]
    found = [
        from_mjcf(xml, DAMPING, times=TIMES, noise=0.01, threads=k) for k in (1, num)
    ]
    whole = found[0].simulator.mean(theta, action)
    assert torch.equal(whole, found[1].simulator.mean(theta, action))
    one = torch.cat(
        [
            found[1].simulator.mean(theta[i : i + 1], action[i : i + 1])
            for i in range(20)
        ]
    )
    assert torch.equal(whole, one)


BAD: dict[str, dict[str, Any]] = {
    "no such joint": {"parameters": {"elbow.damping": (0.0, 1.0)}},
    "no such field": {"parameters": {"hinge.colour": (0.0, 1.0)}},
    "bounds the wrong way": {"parameters": {"hinge.damping": (1.0, 0.0)}},
    "no width": {"parameters": {"hinge.damping": (1.0, 1.0)}},
    "NaN bound": {"parameters": {"hinge.damping": (0.0, float("nan"))}},
    "mass of 0": {"parameters": {"arm.mass": (0.0, 1.0)}},
    "negative mass": {"parameters": {"arm.mass": (-1.0, 1.0)}},
    "no parameters": {"parameters": {}},
    "times NaN": {"times": [0.0, float("nan")]},
    "times negative": {"times": [-1.0, 1.0]},
    "times down": {"times": [1.0, 0.5]},
    "times epoch": {"times": [1.7e9, 1.7e9 + 1]},
    "times empty": {"times": []},
    "threads 0": {"threads": 0},
    "threads -1": {"threads": -1},
    "noise negative": {"noise": -1.0},
    "noise NaN": {"noise": float("nan")},
    "no such sensor": {"sensors": ["gyro"]},
    "no such start": {"start": "away"},
    "no such action": {"actions": BoxActions([0.0], [1.0], names=["elbow"])},
}


@ATTACKS.add("bad input", cases=list(BAD))
def bad(name: str) -> None:
    given = {"parameters": DAMPING, "times": TIMES, "noise": 0.01, **BAD[name]}
    try:
        from_mjcf(held_arm("servo", "position"), **given)
    except (ValueError, TypeError) as error:
        assert "expected" in str(error), error
    else:
        raise AssertionError("accepted")


@ATTACKS.add("a text that is no model", cases=("", "<mujoco>", "hello", "<robot/>"))
def text(xml: str) -> None:
    try:
        from_mjcf(xml, DAMPING, times=TIMES, noise=0.01)
    except (ValueError, OSError) as error:
        assert str(error), error
    else:
        raise AssertionError("accepted")


@ATTACKS.add("models of the benchmarks load", cases=("arm", "cart-pole", "spring"))
def models(name: str) -> None:
    xml = {"arm": ARM, "cart-pole": CART_POLE, "spring": SPRING_MASS}[name]
    model = mujoco.MjModel.from_xml_string(xml)
    joint = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_JOINT, 0)
    robot = from_mjcf(
        xml,
        {f"{joint}.damping": (0.0, 1.0)},
        sensors=[joint],
        actions=BoxActions([-0.2], [0.2], names=[f"{joint} position"]),
        times=[0.1, 0.3],
        noise=0.01,
    )
    values = [torch.tensor([[v]], dtype=torch.float64) for v in (0.2, 0.1)]
    x = robot.simulator.mean(*values)[0].numpy()
    model.dof_damping[model.jnt_dofadr[0]] = 0.2
    data = mujoco.MjData(model)
    data.qpos[model.jnt_qposadr[0]] = 0.1
    angles = []
    for time in (0.1, 0.3):
        while data.time < time - 1e-9:
            mujoco.mj_step(model, data)
        angles.append(data.qpos[model.jnt_qposadr[0]])
    assert np.allclose(x, angles, atol=1e-12), (x, angles)

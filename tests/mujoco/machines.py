"""Machines that tests of MuJoCo simulators share, and the bare loop beside them."""

import mujoco
import numpy as np

BALL = """<mujoco model="bouncing ball"><option timestep="0.002"/><worldbody>
<geom name="floor" type="plane" size="1 1 .1"/>
<body name="ball" pos="0 0 .3"><joint name="height" type="slide" axis="0 0 1"/>
<geom name="skin" type="sphere" size=".05" mass=".1" solref=".02 .2"/></body>
</worldbody>
<sensor><jointpos name="height" joint="height" noise=".001"/></sensor></mujoco>"""

HELD = """
<mujoco><option timestep=".002" integrator="{integrator}"/>
  <worldbody>
    <body name="hand" mocap="true" pos="0 0 1"/>
    <body name="arm"><joint name="hinge" axis="0 1 0" damping=".1"/>
      <geom type="capsule" fromto="0 0 0 .5 0 0" size=".02" mass="1"/></body>
  </worldbody>
  <actuator><{kind} name="{name}" joint="hinge" {gain}/></actuator>
  <equality><connect body1="arm" body2="hand" anchor=".5 0 0"/></equality>
  <sensor><jointpos name="angle" joint="hinge"/></sensor>
  <keyframe><key name="home" qpos=".7" qvel="-1" ctrl=".6" mpos=".3 0 .2"/></keyframe>
</mujoco>
"""
GAINS = {"position": 'kp="50"', "velocity": 'kv="2"', "motor": 'gear="3"'}


def held_arm(name: str, kind: str = "position", integrator: str = "Euler") -> str:
    """Return an arm that an equality holds, with an actuator of a name and kind."""
    return HELD.format(name=name, kind=kind, gain=GAINS[kind], integrator=integrator)


def stepped(text, num_steps, *, key=False, control=None, **fields):
    """Return the sensors of each step of a bare loop, shape (num_steps, k).

    Args:
        text: The MJCF.
        num_steps: Number of steps; sensors are of their beginning.
        key: Whether it starts from the first keyframe.
        control: Control of the first actuator, held.
        fields: First entries of fields, those of the model before those of the state.
    """
    model = mujoco.MjModel.from_xml_string(text)
    data, rows = mujoco.MjData(model), []
    if key:
        mujoco.mj_resetDataKeyframe(model, data, 0)
    for field, value in fields.items():
        getattr(model if hasattr(model, field) else data, field).flat[0] = value
    if control is not None:
        data.ctrl[0] = control
    for _ in range(num_steps):
        mujoco.mj_step(model, data)
        rows.append(data.sensordata.copy())
    return np.array(rows)

"""Two machines that tests of MuJoCo simulators share: a ball, an arm that is held."""

BALL = """
<mujoco model="bouncing ball">
  <option timestep="0.002"/>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 .1"/>
    <body name="ball" pos="0 0 .3">
      <joint name="height" type="slide" axis="0 0 1"/>
      <geom name="skin" type="sphere" size=".05" mass=".1" solref=".02 .2"/>
    </body>
  </worldbody>
  <sensor><jointpos name="height" joint="height" noise=".001"/></sensor>
</mujoco>
"""

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

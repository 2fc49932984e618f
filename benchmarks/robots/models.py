"""Small robots."""

import numpy as np

PENDULUM = """
<mujoco model="pendulum">
  <option timestep="0.01" integrator="implicitfast"/>
  <worldbody>
    <body name="bob">
      <joint name="hinge" axis="0 1 0" damping="0.03"/>
      <geom name="rod" type="capsule" fromto="0 0 0 0 0 -.5" size=".02" mass="1"/>
    </body>
  </worldbody>
  <sensor><jointpos name="encoder" joint="hinge" noise="0.01"/></sensor>
</mujoco>
"""

SPRING_MASS = """
<mujoco model="spring mass">
  <option timestep="0.01" integrator="implicitfast"/>
  <worldbody>
    <body name="cart">
      <joint name="slide" type="slide" axis="1 0 0" stiffness="20" damping="0.5"/>
      <geom type="box" size=".1 .1 .1" mass="1" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  <actuator><motor name="push" joint="slide" ctrlrange="-5 5"/></actuator>
  <sensor>
    <jointpos name="position" joint="slide"/>
    <jointvel name="speed" joint="slide"/>
  </sensor>
</mujoco>
"""

CART_POLE = """
<mujoco model="cart-pole">
  <option timestep="0.01" integrator="implicitfast"/>
  <worldbody>
    <body name="cart">
      <joint name="slide" type="slide" axis="1 0 0" damping="0.1"/>
      <geom type="box" size=".1 .1 .1" mass="1" contype="0" conaffinity="0"/>
      <body name="pole">
        <joint name="hinge" axis="0 1 0" damping="0.002"/>
        <geom type="capsule" fromto="0 0 0 0 0 -.5" size=".02" mass=".2"
              contype="0" conaffinity="0"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="push" joint="slide" gear="2"/></actuator>
  <sensor>
    <jointpos name="x" joint="slide"/>
    <jointpos name="angle" joint="hinge"/>
  </sensor>
</mujoco>
"""

ARM = """
<mujoco model="two-link arm">
  <option timestep="0.005" integrator="implicitfast"/>
  <worldbody>
    <body name="upper">
      <joint name="shoulder" axis="0 1 0" damping="0.1" armature="0.01"/>
      <geom type="capsule" fromto="0 0 0 .3 0 0" size=".03" mass="1"
            contype="0" conaffinity="0"/>
      <body name="lower" pos=".3 0 0">
        <joint name="elbow" axis="0 1 0" damping="0.1" armature="0.01"/>
        <geom type="capsule" fromto="0 0 0 .3 0 0" size=".03" mass=".5"
              contype="0" conaffinity="0"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="shoulder servo" joint="shoulder" kp="50" kv="2"/>
    <position name="elbow servo" joint="elbow" kp="30" kv="1"/>
  </actuator>
</mujoco>
"""

TIMES = np.arange(1, 16) * 0.1

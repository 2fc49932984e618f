"""The servo pendulum in MuJoCo, against which the faster equations are checked."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sbi_active.tasks.box_collision.scene import load_mujoco
from sbi_active.tasks.servo_pendulum.model import GRAVITY, LENGTH, MASS, STEP, SUPPLY
from sbi_active.tasks.servo_pendulum.recordings import Recordings

#: Steps of MuJoCo in one of the equations.
SUBSTEPS = 8

# The motor turns a duty cycle into a torque with a bias that grows with the speed.
SCENE = """
<mujoco>
  <option timestep="{step}" integrator="implicitfast" gravity="0 0 -{gravity}"/>
  <worldbody>
    <body>
      <joint name="shaft" type="hinge" axis="0 1 0" armature="{armature}"
             damping="{viscous}" frictionloss="{coulomb}"
             solreffriction="{stiff} 1" solimpfriction="0.99 0.9999 0.001"/>
      <inertial pos="0 0 -{length}" mass="{mass}" diaginertia="1e-9 1e-9 1e-9"/>
    </body>
  </worldbody>
  <actuator>
    <general joint="shaft" ctrlrange="-1 1" ctrllimited="true" gainprm="{stall}"
             biastype="affine" biasprm="0 0 -{brake}"/>
  </actuator>
</mujoco>
"""


def mujoco_angles(
    theta: NDArray[Any],
    recordings: Recordings,
    trial: int,
    *,
    coulomb: float = 0.0,
    viscous: float = 0.0,
) -> NDArray[Any]:
    """Return the angles that the encoder reads in one recorded trial.

    Args:
        theta: As in :mod:`.model`, shape (5,).
        recordings: Hold the trial.
        trial: Row of the recordings.
        coulomb: Dry friction, N m.
        viscous: Viscous friction, N m s/rad.

    Returns:
        Shape (k,), rad.

    Raises:
        ImportError: If MuJoCo is not installed.
    """
    mujoco = load_mujoco()
    kt, resistance, gain, armature, zero = map(float, theta)
    step = STEP / SUBSTEPS
    stall, brake = SUPPLY * kt / resistance, kt**2 / resistance
    model = mujoco.MjModel.from_xml_string(
        SCENE.format(
            step=step,
            gravity=GRAVITY,
            armature=armature,
            viscous=viscous,
            coulomb=coulomb,
            stiff=4 * step,
            length=LENGTH,
            mass=MASS,
            stall=stall,
            brake=brake,
        )
    )
    data = mujoco.MjData(model)
    data.qpos[0] = recordings.start[trial] - zero
    goal, enabled = recordings.goal[trial], recordings.enabled[trial]
    kp, every = recordings.kp[trial], recordings.every
    x = np.empty(len(goal) // every)
    for k, (r, on) in enumerate(zip(goal, enabled, strict=True)):
        # An open bridge has neither voltage nor back-EMF.
        model.actuator_gainprm[0, 0] = on * stall
        model.actuator_biasprm[0, 2] = -on * brake
        for _ in range(SUBSTEPS):
            data.ctrl[0] = gain * kp * (r - zero - data.qpos[0])
            mujoco.mj_step(model, data)
        if (k + 1) % every == 0:
            x[(k + 1) // every - 1] = data.qpos[0] + zero
    return x

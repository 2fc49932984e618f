"""Robots: MuJoCo models as simulators, and what a plain model lacks as effects.

Here lives what reads an MJCF or the data of ``mujoco.sysid`` and gives the library's
own simulator, prior, actions and trials, and what gives a belief back to MuJoCo's
tools. No inference, and no criticism of models, is done here. Needs
``sbi-active[mujoco]``.
"""

from sbi_active.criticism.forces.library import force_effects
from sbi_active.mujoco.beliefs import belief_to_parameters, randomization
from sbi_active.mujoco.effects.library import mjcf_effects
from sbi_active.mujoco.identification import identify_robot
from sbi_active.mujoco.limits import MotionLimits
from sbi_active.mujoco.robot import Robot, from_mjcf
from sbi_active.mujoco.sysid import from_sysid

__all__ = [
    "MotionLimits",
    "Robot",
    "belief_to_parameters",
    "force_effects",
    "from_mjcf",
    "from_sysid",
    "identify_robot",
    "mjcf_effects",
    "randomization",
]

"""Robots: MuJoCo models as simulators, and what a plain model lacks as effects.

This package reads an MJCF or the data of ``mujoco.sysid`` and returns the library's own
simulator, prior, actions and trials. It also converts a belief for MuJoCo's tools. It
does not infer, and does not criticize models. It needs ``sbi-active[mujoco]``.
"""

from sbi_active.criticism.forces.library import force_effects
from sbi_active.mujoco.beliefs import (
    belief_to_parameters,
    identify_robot,
    randomization,
)
from sbi_active.mujoco.effects.library import mjcf_effects
from sbi_active.mujoco.limits import MotionLimits
from sbi_active.mujoco.robot import from_mjcf
from sbi_active.mujoco.sysid import from_sysid
from sbi_active.renamed import former_names

__all__ = [
    "MotionLimits",
    "belief_to_parameters",
    "force_effects",
    "from_mjcf",
    "from_sysid",
    "identify_robot",
    "mjcf_effects",
    "randomization",
]

__getattr__ = former_names(__name__)

"""Declared effects that a simulator may lack, and the simulator that has them.

Here live effects, their checks and priors. How well one explains trials does not.
"""

from sbi_active.criticism.effects.declarations import require_nested
from sbi_active.criticism.effects.joint_prior import JointPrior

__all__ = ["JointPrior", "require_nested"]

"""Declared effects that a simulator may lack, and the simulator that has them.

This package contains effects, their checks and priors. The comparison of effects with
trials is elsewhere.
"""

from sbi_active.criticism.effects.joint_prior import JointPrior

__all__ = ["JointPrior"]

"""Undeclared generalized forces: a dictionary of what a joint may lack.

This package contains the forces, their sizes along nominal trajectories, and the
effects made of them. The comparison of forces with trials is elsewhere.
"""

from sbi_active.criticism.forces.dictionary import Force, total_force
from sbi_active.criticism.forces.library import force_effects

__all__ = ["Force", "force_effects", "total_force"]

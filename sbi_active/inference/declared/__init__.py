"""The posterior under declared noise: its likelihood is simulated, and so exact.

This package makes a belief of a fit: its diagnostics, and the trials that contradict
one another. It contains no regression.
"""

from sbi_active.inference.declared.refining import refine_declared
from sbi_active.inference.declared.settings import RefinementOptions
from sbi_active.inference.declared.simulated_belief import SimulatedBelief

__all__ = ["RefinementOptions", "SimulatedBelief", "refine_declared"]

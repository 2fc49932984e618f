"""The posterior under declared noise: its likelihood is simulated, and so exact.

Here lives what makes a belief of a fit: how far it is to be trusted, and what trials
show that contradict one another. Nothing is regressed here.
"""

from sbi_active.inference.declared.refining import refine_declared
from sbi_active.inference.declared.settings import RefinementOptions
from sbi_active.inference.declared.simulated_belief import SimulatedBelief

__all__ = ["RefinementOptions", "SimulatedBelief", "refine_declared"]

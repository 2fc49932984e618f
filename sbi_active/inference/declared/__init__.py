"""The posterior under declared noise: its likelihood is simulated, and so exact.

Here live that likelihood, searches of its modes, samplers, and what trials show that
contradict one another. Nothing is regressed here.
"""

from sbi_active.inference.declared.importance import importance_sample
from sbi_active.inference.declared.simulated_belief import SimulatedBelief
from sbi_active.inference.declared.simulated_likelihood import (
    MeanTable,
    SimulatedLikelihood,
    declares_noise,
)

__all__ = [
    "MeanTable",
    "SimulatedBelief",
    "SimulatedLikelihood",
    "declares_noise",
    "importance_sample",
]

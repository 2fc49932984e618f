"""The posterior of a potential: search, importance sampling, sequential Monte Carlo.

``infer`` knows a potential and nothing of campaigns or verdicts.
"""

from sbi_active.inference.engine.infer import infer
from sbi_active.inference.engine.pool import Fit, WeightedDraws
from sbi_active.inference.engine.potential import Potential, SimulatedPotential
from sbi_active.inference.engine.search import Found, search
from sbi_active.inference.engine.settings import Settings

__all__ = [
    "Fit",
    "Found",
    "Potential",
    "Settings",
    "SimulatedPotential",
    "WeightedDraws",
    "infer",
    "search",
]

"""The posterior of a potential: search, importance sampling, sequential Monte Carlo.

``infer`` knows a potential and nothing of campaigns or verdicts.
"""

from sbi_active.inference.engine.infer import Fit, Settings, infer
from sbi_active.inference.engine.potential import SimulatedPotential
from sbi_active.inference.engine.search import Found, search

__all__ = ["Fit", "Found", "Settings", "SimulatedPotential", "infer", "search"]

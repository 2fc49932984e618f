"""Samplers and proposals over the parameters' unbounded coordinates.

This package contains tools that know a density and nothing of trials, networks or
simulators.
"""

from sbi_active.inference.sampling.coordinates import PriorCoordinates
from sbi_active.inference.sampling.gaussian_mixture import GaussianMixture
from sbi_active.inference.sampling.unbounding import Unbounding
from sbi_active.inference.sampling.weights import log_sum_exp, normalized

__all__ = [
    "GaussianMixture",
    "PriorCoordinates",
    "Unbounding",
    "log_sum_exp",
    "normalized",
]

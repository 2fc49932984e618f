"""Models of the noise of a measurement, and their estimation from repeats.

Here live densities of x given its mean. What gives the mean does not.
"""

from sbi_active.simulation.noise.autocorrelated import AutocorrelatedNoise
from sbi_active.simulation.noise.estimation import estimate_noise
from sbi_active.simulation.noise.gaussian import GaussianNoise, NoiseModel
from sbi_active.simulation.noise.student import StudentTNoise

__all__ = [
    "AutocorrelatedNoise",
    "GaussianNoise",
    "NoiseModel",
    "StudentTNoise",
    "estimate_noise",
]

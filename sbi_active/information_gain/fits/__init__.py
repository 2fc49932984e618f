"""Regressions, densities and classifiers that the estimators rest on.

This package contains fits to simulations of one action. It does not estimate any
information gain.
"""

from sbi_active.information_gain.fits.classification import cross_fitted, probability
from sbi_active.information_gain.fits.cross_fitting import (
    cross_fit,
    patterns_of_numbers,
)
from sbi_active.information_gain.fits.emulator import MeanEmulator
from sbi_active.information_gain.fits.noise_kernels import noise_members
from sbi_active.information_gain.fits.presence import (
    presence_information,
    presence_notes,
    random_presence,
)
from sbi_active.information_gain.fits.smoothing import declare

__all__ = [
    "MeanEmulator",
    "cross_fit",
    "cross_fitted",
    "declare",
    "noise_members",
    "patterns_of_numbers",
    "presence_information",
    "presence_notes",
    "probability",
    "random_presence",
]

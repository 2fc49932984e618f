"""Regression of outcomes on parameters, where a posterior is.

Here live rows, regions, polynomials and their errors. What is done with them lives in
``refinement``.
"""

from sbi_active.inference.regression.basis import Basis
from sbi_active.inference.regression.histories import Histories
from sbi_active.inference.regression.outcomes import TrialOutcome, outcomes_of
from sbi_active.inference.regression.regions import (
    SPREAD,
    Region,
    cover,
    nearest_region,
    whole_space,
)
from sbi_active.inference.regression.surrogate import (
    LocalRegression,
    Surrogate,
    estimate_noise,
)

__all__ = [
    "Basis",
    "Histories",
    "LocalRegression",
    "Region",
    "SPREAD",
    "Surrogate",
    "TrialOutcome",
    "cover",
    "estimate_noise",
    "nearest_region",
    "outcomes_of",
    "whole_space",
]

"""Likelihoods learned from few simulations, which all trials and rounds share.

Here live a pool of simulations and Gaussian processes on them. The loop that asks for
more, samples and judges is that of ``refinement``.
"""

from sbi_active.inference.emulation.likelihood import (
    PooledLikelihood,
    TrialLikelihood,
)
from sbi_active.inference.emulation.pool import Batch, Pool
from sbi_active.inference.emulation.processes import Processes
from sbi_active.inference.emulation.summaries import Summary, fitted_summaries

__all__ = [
    "Batch",
    "Pool",
    "PooledLikelihood",
    "Processes",
    "Summary",
    "TrialLikelihood",
    "fitted_summaries",
]

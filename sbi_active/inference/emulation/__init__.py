"""Likelihoods learned from few simulations, which all trials and rounds share.

Here live a pool of simulations, Gaussian processes on them, and the posterior of all
trials by these. For simulators that are cheap, see ``refinement``.
"""

from sbi_active.inference.emulation.likelihood import (
    PooledLikelihood,
    TrialLikelihood,
)
from sbi_active.inference.emulation.pool import Batch, Pool
from sbi_active.inference.emulation.posterior import PooledPosterior
from sbi_active.inference.emulation.summaries import Summary, fitted_summaries

__all__ = [
    "Batch",
    "Pool",
    "PooledLikelihood",
    "PooledPosterior",
    "Summary",
    "TrialLikelihood",
    "fitted_summaries",
]

"""Networks and what prepares their inputs.

This package contains densities and classifiers of plain tensors, and their training.
Their meaning for an action is in ``models``.
"""

from sbi_active.inference.networks.action_scaling import (
    ActionScaling,
    Polynomials,
    exponents_of,
)
from sbi_active.inference.networks.baseline import Baseline, local
from sbi_active.inference.networks.conditioning import Conditioning
from sbi_active.inference.networks.mixture_density import MixtureDensityNetwork
from sbi_active.inference.networks.mixture_network import PreparedLoss
from sbi_active.inference.networks.response import Response
from sbi_active.inference.networks.training import TrainingBudget, train_mixture_density

__all__ = [
    "ActionScaling",
    "Baseline",
    "Conditioning",
    "MixtureDensityNetwork",
    "Polynomials",
    "PreparedLoss",
    "Response",
    "TrainingBudget",
    "exponents_of",
    "local",
    "train_mixture_density",
]

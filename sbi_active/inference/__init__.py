"""Inference of parameters from trials with actions."""

from sbi_active.inference.asbi import ASBI
from sbi_active.inference.belief import Belief, ChainedBelief, information_gained
from sbi_active.inference.condition import ActionEmbedding
from sbi_active.inference.mixture_density import MixtureDensity, MixtureDensityNetwork
from sbi_active.inference.posterior import ActionPosterior
from sbi_active.inference.refine import Refinement, refine
from sbi_active.inference.refined_belief import RefinedBelief
from sbi_active.inference.rounds import Observation

__all__ = [
    "ASBI",
    "ActionEmbedding",
    "ActionPosterior",
    "Belief",
    "ChainedBelief",
    "MixtureDensity",
    "MixtureDensityNetwork",
    "Observation",
    "RefinedBelief",
    "Refinement",
    "information_gained",
    "refine",
]

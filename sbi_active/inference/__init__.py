"""Inference of parameters from trials with actions."""

from sbi_active.inference.beliefs.belief import (
    Belief,
    ChainedBelief,
    information_gained,
)
from sbi_active.inference.beliefs.kernel_belief import KernelBelief
from sbi_active.inference.models.action_likelihood import ActionLikelihood
from sbi_active.inference.models.action_ratio import ActionRatio
from sbi_active.inference.models.lfire import LFIRE
from sbi_active.inference.models.posterior import ActionPosterior
from sbi_active.inference.networks.mixture_density import (
    MixtureDensity,
    MixtureDensityNetwork,
)
from sbi_active.inference.networks.ratio_network import RatioClassifier
from sbi_active.inference.products.belief import ProductBelief
from sbi_active.inference.refinement.learned_belief import RefinedBelief
from sbi_active.inference.refinement.stages import Refinement, refine
from sbi_active.inference.rounds.condition import ActionEmbedding
from sbi_active.inference.rounds.rows import Observation
from sbi_active.inference.trainers.alhi import ALHI
from sbi_active.inference.trainers.asbi import ASBI
from sbi_active.inference.trainers.protocol import ActiveInference
from sbi_active.inference.trainers.ratio import SeqBED_B, SeqBED_C
from sbi_active.inference.trainers.seqbed import SeqBED

__all__ = [
    "ALHI",
    "ASBI",
    "ActionEmbedding",
    "ActionLikelihood",
    "ActionPosterior",
    "ActionRatio",
    "ActiveInference",
    "Belief",
    "ChainedBelief",
    "KernelBelief",
    "LFIRE",
    "MixtureDensity",
    "MixtureDensityNetwork",
    "Observation",
    "ProductBelief",
    "RatioClassifier",
    "RefinedBelief",
    "Refinement",
    "SeqBED",
    "SeqBED_B",
    "SeqBED_C",
    "information_gained",
    "refine",
]

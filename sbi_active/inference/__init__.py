"""Inference of parameters from trials with actions."""

from sbi_active.inference.action_likelihood import ActionLikelihood
from sbi_active.inference.action_ratio import ActionRatio
from sbi_active.inference.active import ActiveInference
from sbi_active.inference.alhi import ALHI
from sbi_active.inference.amortized_seqbed import SeqBED_B, SeqBED_C
from sbi_active.inference.asbi import ASBI
from sbi_active.inference.belief import Belief, ChainedBelief, information_gained
from sbi_active.inference.condition import ActionEmbedding
from sbi_active.inference.kernel_belief import KernelBelief
from sbi_active.inference.lfire import LFIRE
from sbi_active.inference.mixture_density import MixtureDensity, MixtureDensityNetwork
from sbi_active.inference.posterior import ActionPosterior
from sbi_active.inference.product_belief import ProductBelief
from sbi_active.inference.ratio_network import RatioClassifier
from sbi_active.inference.refine import Refinement, refine
from sbi_active.inference.refined_belief import RefinedBelief
from sbi_active.inference.rounds import Observation
from sbi_active.inference.seqbed import SeqBED

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

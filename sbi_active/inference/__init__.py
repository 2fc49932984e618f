"""Inference of parameters from trials with actions.

This package leads from simulations and trials to beliefs; each package below says which
part it does. The choice of the next action is in ``design``.
"""

from sbi_active.inference.beliefs.belief import Belief
from sbi_active.inference.declared.settings import RefinementOptions
from sbi_active.inference.emulation.refining import refine
from sbi_active.inference.models.lfire import LFIRE
from sbi_active.inference.models.posterior import ActionPosterior
from sbi_active.inference.networks.mixture_density import MixtureDensity
from sbi_active.inference.rounds.condition import ActionEmbedding
from sbi_active.inference.trainers.asbi import ASBI
from sbi_active.inference.trainers.base import ActiveInference
from sbi_active.inference.trainers.factored import ALHI, SeqBED
from sbi_active.inference.trainers.seqbed import SeqBED_LFIRE
from sbi_active.renamed import former_names

__all__ = [
    "ALHI",
    "ASBI",
    "ActionEmbedding",
    "ActionPosterior",
    "ActiveInference",
    "Belief",
    "LFIRE",
    "MixtureDensity",
    "RefinementOptions",
    "SeqBED",
    "SeqBED_LFIRE",
    "refine",
]

__getattr__ = former_names(__name__)

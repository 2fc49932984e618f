"""Active simulation-based inference: tune a black-box simulator from few real trials.

Choose the action whose outcome tells most about the simulator's parameters, update a
neural posterior with the measurement, and go on. An extension of sbi.
"""

from __future__ import annotations

from importlib.metadata import version
from typing import TYPE_CHECKING, Any

from sbi_active.actions import (
    ActionSpace,
    BoxActions,
    DiscreteActions,
    MixedActions,
)
from sbi_active.campaign import Campaign, CampaignOptions, StopRules, Trial
from sbi_active.design.designer import Design, InformationGainDesigner, RandomDesigner
from sbi_active.inference import (
    ALHI,
    ASBI,
    ActionEmbedding,
    ActionLikelihood,
    ActionPosterior,
    ActionRatio,
    ActiveInference,
    Belief,
    MixtureDensity,
    Refinement,
    SeqBED,
    SeqBED_B,
    SeqBED_C,
)
from sbi_active.simulation import (
    AutocorrelatedNoise,
    Bank,
    GaussianNoise,
    Simulations,
    SimulatorModel,
    StudentTNoise,
    estimate_noise,
    simulate,
    unknown_noise,
)

if TYPE_CHECKING:
    from sbi_active.export import to_inference_data

__version__ = version("sbi-active")

__all__ = [
    "ALHI",
    "ASBI",
    "ActionEmbedding",
    "ActionLikelihood",
    "ActionPosterior",
    "ActionRatio",
    "ActionSpace",
    "ActiveInference",
    "AutocorrelatedNoise",
    "Bank",
    "Belief",
    "BoxActions",
    "Campaign",
    "CampaignOptions",
    "Design",
    "DiscreteActions",
    "GaussianNoise",
    "InformationGainDesigner",
    "MixedActions",
    "MixtureDensity",
    "RandomDesigner",
    "Refinement",
    "SeqBED",
    "SeqBED_B",
    "SeqBED_C",
    "Simulations",
    "SimulatorModel",
    "StopRules",
    "StudentTNoise",
    "Trial",
    "estimate_noise",
    "simulate",
    "to_inference_data",
    "unknown_noise",
]


def __getattr__(name: str) -> Any:
    if name == "to_inference_data":  # ArviZ takes seconds to import
        from sbi_active.export import to_inference_data

        return to_inference_data
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")

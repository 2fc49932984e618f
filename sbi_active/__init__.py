"""Active simulation-based inference: tune a black-box simulator from few real trials.

Choose the action whose outcome tells most about the simulator's parameters, update a
neural posterior with the measurement, and go on. An extension of sbi.

This module has the names that most programs need; each is imported when it is first
used. All others are in the packages: ``actions``, ``simulation``, ``inference``,
``design``, ``diagnostics``, ``campaign``, ``criticism`` and ``mujoco``.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from sbi_active.renamed import lazy_names

if TYPE_CHECKING:
    from sbi_active.actions import BoxActions, DiscreteActions, MixedActions
    from sbi_active.campaign import Campaign, CampaignOptions, StopRules
    from sbi_active.design import InformationGainDesigner, RandomDesigner
    from sbi_active.export import to_datatree, to_inference_data
    from sbi_active.inference import (
        ALHI,
        ASBI,
        Belief,
        MixtureDensity,
        RefinementOptions,
        SeqBED,
    )
    from sbi_active.simulation import (
        AutocorrelatedNoise,
        Bank,
        GaussianNoise,
        SimulatorModel,
        StudentTNoise,
        estimate_noise,
        simulate,
    )

    __version__: str

__all__ = [
    "ALHI",
    "ASBI",
    "AutocorrelatedNoise",
    "Bank",
    "Belief",
    "BoxActions",
    "Campaign",
    "CampaignOptions",
    "DiscreteActions",
    "GaussianNoise",
    "InformationGainDesigner",
    "MixedActions",
    "MixtureDensity",
    "RandomDesigner",
    "RefinementOptions",
    "SeqBED",
    "SimulatorModel",
    "StopRules",
    "StudentTNoise",
    "estimate_noise",
    "simulate",
    "to_datatree",
    "to_inference_data",
]

#: Packages, which are imported when they are first used as well.
_PACKAGES = (
    *("actions", "campaign", "criticism", "design", "diagnostics", "inference"),
    *("mujoco", "simulation"),
)

_find = lazy_names(__name__)


def __getattr__(name: str) -> Any:
    if name in (*_PACKAGES, "export"):
        return import_module(f"{__name__}.{name}")
    if name == "__version__":
        from importlib.metadata import version

        return version("sbi-active")
    return _find(name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, *_PACKAGES, "__version__"})

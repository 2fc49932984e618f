"""Design: which action to take next, by what its outcome is expected to tell.

This package contains the designers, and the steps between a belief and a choice:
outcomes of candidates, searches for candidates, and in ``estimators`` what an outcome
tells, in nats. It contains no inference of parameters.
"""

from sbi_active.design.design import Design
from sbi_active.design.designer import InformationGainDesigner
from sbi_active.design.estimators.base import InformationGainEstimator
from sbi_active.design.estimators.contrast import (
    LikelihoodGain,
    PosteriorGain,
    RatioGain,
)
from sbi_active.design.estimators.entropy import EntropyGain
from sbi_active.design.estimators.linear import LinearGain
from sbi_active.design.estimators.model_index import ModelIndexGain
from sbi_active.design.estimators.nested import NestedGain
from sbi_active.design.random_designer import RandomDesigner
from sbi_active.design.search import GradientSearch, Search

__all__ = [
    "Design",
    "EntropyGain",
    "GradientSearch",
    "InformationGainDesigner",
    "InformationGainEstimator",
    "LikelihoodGain",
    "LinearGain",
    "ModelIndexGain",
    "NestedGain",
    "PosteriorGain",
    "RandomDesigner",
    "RatioGain",
    "Search",
]

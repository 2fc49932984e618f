"""Estimators of the expected information gain, one a file."""

from sbi_active.information_gain.base import (
    CandidateSimulations,
    InformationGainEstimator,
)
from sbi_active.information_gain.entropy import EntropyGain
from sbi_active.information_gain.model_index import (
    ModelIndexGain,
    RivalPredictive,
    RivalSampler,
)
from sbi_active.information_gain.nested import NestedGain
from sbi_active.information_gain.parameters import ParameterGain
from sbi_active.information_gain.posterior import PosteriorGain

__all__ = [
    "CandidateSimulations",
    "EntropyGain",
    "InformationGainEstimator",
    "ModelIndexGain",
    "NestedGain",
    "ParameterGain",
    "PosteriorGain",
    "RivalPredictive",
    "RivalSampler",
]

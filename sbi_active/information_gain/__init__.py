"""Estimators of the expected information gain, one a file."""

from sbi_active.information_gain.base import (
    CandidateSimulations,
    InformationGainEstimator,
)
from sbi_active.information_gain.contrastive import ContrastiveGain
from sbi_active.information_gain.entropy import EntropyGain
from sbi_active.information_gain.info_nce import InfoNCEGain
from sbi_active.information_gain.likelihood import LikelihoodGain
from sbi_active.information_gain.model_index import (
    ModelIndexGain,
    RivalPredictive,
    RivalSampler,
)
from sbi_active.information_gain.nested import NestedGain
from sbi_active.information_gain.parameters import ParameterGain
from sbi_active.information_gain.posterior import PosteriorGain
from sbi_active.information_gain.ratio import RatioGain
from sbi_active.information_gain.variational_nested import VariationalNestedGain

__all__ = [
    "CandidateSimulations",
    "ContrastiveGain",
    "EntropyGain",
    "InfoNCEGain",
    "InformationGainEstimator",
    "LikelihoodGain",
    "ModelIndexGain",
    "NestedGain",
    "ParameterGain",
    "PosteriorGain",
    "RatioGain",
    "RivalPredictive",
    "RivalSampler",
    "VariationalNestedGain",
]

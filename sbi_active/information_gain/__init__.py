"""Estimators of the expected information gain, one a file."""

from sbi_active.information_gain.base import (
    CandidateSimulations,
    InformationGainEstimator,
)
from sbi_active.information_gain.estimators.contrastive import ContrastiveGain
from sbi_active.information_gain.estimators.entropy import EntropyGain
from sbi_active.information_gain.estimators.info_nce import InfoNCEGain
from sbi_active.information_gain.estimators.likelihood import LikelihoodGain
from sbi_active.information_gain.estimators.model_index import (
    ModelIndexGain,
    RivalPredictive,
    RivalSampler,
)
from sbi_active.information_gain.estimators.nested import NestedGain
from sbi_active.information_gain.estimators.parameters import ParameterGain
from sbi_active.information_gain.estimators.posterior import PosteriorGain
from sbi_active.information_gain.estimators.ratio import RatioGain
from sbi_active.information_gain.estimators.variational_nested import (
    VariationalNestedGain,
)

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

"""Estimators of the expected information gain, one a file.

This package estimates the worth of a trial of an action, in nats. The choice of the
actions to compare is in ``search`` and ``design``.
"""

from sbi_active.information_gain.base import (
    CandidateSimulations,
    InformationGainEstimator,
)
from sbi_active.information_gain.estimators.contrastive import ContrastiveGain
from sbi_active.information_gain.estimators.entropy import EntropyGain
from sbi_active.information_gain.estimators.info_nce import InfoNCEGain
from sbi_active.information_gain.estimators.likelihood import LikelihoodGain
from sbi_active.information_gain.estimators.linear import LinearGain
from sbi_active.information_gain.estimators.model_index import (
    ModelIndexGain,
    RivalSampler,
)
from sbi_active.information_gain.estimators.nested import NestedGain
from sbi_active.information_gain.estimators.parameters import ParameterGain
from sbi_active.information_gain.estimators.posterior import PosteriorGain
from sbi_active.information_gain.estimators.ratio import RatioGain
from sbi_active.information_gain.estimators.variational_nested import (
    VariationalNestedGain,
)
from sbi_active.renamed import former_names

__all__ = [
    "CandidateSimulations",
    "ContrastiveGain",
    "EntropyGain",
    "InfoNCEGain",
    "InformationGainEstimator",
    "LikelihoodGain",
    "LinearGain",
    "ModelIndexGain",
    "NestedGain",
    "ParameterGain",
    "PosteriorGain",
    "RatioGain",
    "RivalSampler",
    "VariationalNestedGain",
]

__getattr__ = former_names(
    __name__,
    {
        "RivalPredictive": "sbi_active.information_gain.estimators.model_index"
        ":RivalPredictive",
    },
)

"""Former home of the estimators of an information gain: ``sbi_active.design``."""

from sbi_active.renamed import former_names

__all__: list[str] = []

__getattr__ = former_names(
    __name__,
    {
        "CandidateSimulations": (
            "sbi_active.design.estimators.base:CandidateSimulations"
        ),
        "ContrastiveGain": "sbi_active.design.estimators.contrast:InfoNCEGain",
        "EntropyGain": "sbi_active.design:EntropyGain",
        "InfoNCEGain": "sbi_active.design.estimators.contrast:InfoNCEGain",
        "InformationGainEstimator": "sbi_active.design:InformationGainEstimator",
        "LikelihoodGain": "sbi_active.design:LikelihoodGain",
        "LinearGain": "sbi_active.design:LinearGain",
        "ModelIndexGain": "sbi_active.design:ModelIndexGain",
        "NestedGain": "sbi_active.design:NestedGain",
        "ParameterGain": "sbi_active.design.estimators.posterior:ParameterGain",
        "PosteriorGain": "sbi_active.design:PosteriorGain",
        "RatioGain": "sbi_active.design:RatioGain",
        "RivalPredictive": "sbi_active.design.estimators.model_index:RivalPredictive",
        "RivalSampler": "sbi_active.design.estimators.model_index:RivalSampler",
    },
)

"""The evidence of each rival: its best fit, its posterior draws and its normalizer.

Here live optimizers and samplers over rivals. What is concluded lives in ``steps``.
"""

from sbi_active.criticism.evidence.importance import lower_factors
from sbi_active.criticism.evidence.outliers import OneOutlier
from sbi_active.criticism.evidence.rival_set import RivalSet
from sbi_active.criticism.evidence.unknown_scale import SCALES, log_evidence

__all__ = ["OneOutlier", "RivalSet", "SCALES", "log_evidence", "lower_factors"]

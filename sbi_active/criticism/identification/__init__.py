"""Identification: from trajectories to a belief whose intervals hold, in one call.

Here live doubtful effects beside the parameters, errors of unknown size in each
channel, and what disagreement between trials adds to an interval. Fits and kernels are
those of ``linear``; what names an effect lives in ``steps`` and ``misfit``.
"""

from sbi_active.criticism.identification.identify import IdentifiedBelief, identify
from sbi_active.criticism.identification.settings import IdentifySettings

__all__ = ["IdentifiedBelief", "IdentifySettings", "identify"]

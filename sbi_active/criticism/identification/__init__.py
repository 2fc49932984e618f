"""Identification: from trajectories to a belief whose intervals hold, in one call.

This package handles doubtful effects beside the parameters, errors of unknown size in
each channel, and the disagreement between trials that widens an interval. Fits and
kernels are those of ``linear``; effects are named in ``steps`` and ``misfit``.
"""

from sbi_active.criticism.identification.identify import IdentifiedBelief, identify
from sbi_active.criticism.identification.settings import IdentifySettings

__all__ = ["IdentifiedBelief", "IdentifySettings", "identify"]

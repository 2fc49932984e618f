"""Identification: from trajectories to a belief whose intervals hold, in one call.

Here live errors of unknown size and duration, doubtful effects beside the parameters,
and what disagreement between trials adds to an interval. What names an effect lives in
``steps`` and ``misfit``.
"""

from sbi_active.criticism.identification.identify import IdentifiedBelief, identify

__all__ = ["IdentifiedBelief", "identify"]

"""Which trial has a gross error, if one has."""

from __future__ import annotations

import numpy as np

from sbi_active.criticism.evidence.rival_set import RivalSet
from sbi_active.criticism.results import OUTLIER, ModelKey


def gross_errors(rivals: RivalSet) -> dict[float, float]:
    """Return the probability that each trial is the one, if one has a gross error.

    Args:
        rivals: The models, whose "outlier" has its evidence.

    Returns:
        By the trial's index, most probable first.
    """
    _, weights, residual = rivals.fit(ModelKey(error=OUTLIER)).weighted()
    error = rivals.one_outlier()
    share = weights @ error.responsibility(residual)
    order = np.argsort(-share, kind="stable")
    index = rivals.trials.index.numpy()[error.trials]
    return {float(index[k]): float(share[k]) for k in order}

r"""Actions at which a verdict would be put to the test most.

A verdict may be the alias of an effect that was not declared: it explains the trials at
hand about as well, with other parameters. The data cannot tell, another action can. The
rival without a cause is a free residual, the bare model and the residual process as
fitted to the trials. Where it expects an outcome far from the verdict's prediction, the
verdict stands or falls by the trial:

.. math::
    d^2 = \frac{1}{N} \sum_i \frac{(\mu_i - \mu^r_i)^2 + (s^r_i)^2}{s_i^2} - 1

with means and standard deviations, noise included, of the verdict's prediction of the N
numbers of x and, with r, of the residual's. A prediction equal to the verdict's has
d = 0.

References:
    Mayo, Error and the Growth of Experimental Knowledge (1996), on severe tests.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from sbi_active.actions import ActionSpace
from sbi_active.arrays import Array
from sbi_active.criticism.contradictions import SevereTest
from sbi_active.criticism.evidence.rival_set import RivalSet
from sbi_active.criticism.next_trial.candidates import (
    PLAN,
    extrapolated,
    following,
    permitted_candidates,
    simulated,
)
from sbi_active.criticism.results import UNEXPLAINED, ModelKey, Tracing
from sbi_active.criticism.steps.predictive import Prediction, predict


def severe_tests(
    rivals: RivalSet, tracing: Tracing, actions: ActionSpace
) -> tuple[SevereTest, ...]:
    """Return the permitted action that tests a named verdict most, and one beyond.

    Args:
        rivals: The models.
        tracing: The verdict; one that names no effect has none.
        actions: The permitted ones.
    """
    if not tracing.chosen:
        return ()
    candidates = permitted_candidates(rivals, actions)
    few = min(PLAN.max_tests, _affordable(rivals))
    beyond = extrapolated(actions, candidates, limit=few)
    # Where every model has a residual process, the bare model has one too.
    free = ModelKey(error=None if tracing.misfit else UNEXPLAINED)
    tested = (
        (_spread_out(candidates, few), True),
        (simulated(rivals, beyond), False),
    )
    return tuple(
        _most_severe(rivals, tracing.key, free, some, is_permitted=is_permitted)
        for some, is_permitted in tested
        if len(some)
    )


def _most_severe(
    rivals: RivalSet,
    key: ModelKey,
    residual: ModelKey,
    candidates: Tensor,
    *,
    is_permitted: bool,
) -> SevereTest:
    trials = following(rivals, candidates)
    options = {"num_draws": PLAN.num_draws, "scored": False}
    verdict = predict(rivals, trials, key=key, **options)
    free = predict(rivals, trials, key=residual, **options)
    difference = _difference(verdict, free, len(candidates))
    best = int(np.argmax(difference))
    return SevereTest(
        action=candidates[best].double().numpy(),
        is_permitted=is_permitted,
        difference=float(difference[best]),
    )


def _difference(verdict: Prediction, free: Prediction, num: int) -> Array:
    """Return d of each trial, shape (num,)."""
    (_, sd), (_, spread) = verdict.moments(), free.moments()
    square = ((free.middle - verdict.middle) ** 2 + spread**2) / sd**2
    trial = verdict.measurements.trial
    total = np.bincount(trial, square, minlength=num)
    size = np.bincount(trial, minlength=num)
    return np.sqrt(np.maximum(total / np.maximum(size, 1) - 1, 0.0))


def _affordable(rivals: RivalSet) -> int:
    """Return the number of candidates that the residual process predicts in memory."""
    m = rivals.measurements
    return max(PLAN.max_entries // (len(m) * int(np.prod(m.shape[1:]))), 2)


def _spread_out(candidates: Tensor, limit: int) -> Tensor:
    """Return at most so many, evenly in their order, with the first and the last."""
    if len(candidates) <= limit:
        return candidates
    return candidates[torch.linspace(0, len(candidates) - 1, limit).round().long()]

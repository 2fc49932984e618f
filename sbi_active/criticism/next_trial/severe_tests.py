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
from torch import Tensor

from sbi_active.actions import ActionSpace
from sbi_active.criticism.contradictions import SevereTest
from sbi_active.criticism.evidence.rival_set import RivalSet
from sbi_active.criticism.next_trial.next_action import (
    PLAN,
    beyond_range,
    following,
    permitted_candidates,
    simulated,
    spread_out,
)
from sbi_active.criticism.results import UNEXPLAINED, ModelKey, Tracing
from sbi_active.criticism.steps.predictive import predict


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
    m = rivals.measurements
    # As many as the residual process predicts in memory.
    most = max(PLAN.max_entries // (len(m) * int(np.prod(m.shape[1:]))), 2)
    few = min(PLAN.max_tests, most)
    farther = simulated(rivals, beyond_range(actions, candidates, limit=few))
    each = ((spread_out(candidates, few), True), (farther, False))
    return tuple(
        _most_severe(rivals, tracing, some, is_permitted=is_permitted)
        for some, is_permitted in each
        if len(some)
    )


def _most_severe(
    rivals: RivalSet, tracing: Tracing, candidates: Tensor, *, is_permitted: bool
) -> SevereTest:
    trials = following(rivals, candidates)
    # Where every model has a residual process, the bare model has one too.
    residual = ModelKey(error=None if tracing.misfit else UNEXPLAINED)
    options = {"num_draws": PLAN.num_draws, "scored": False}
    verdict = predict(rivals, trials, key=tracing.key, **options)
    free = predict(rivals, trials, key=residual, **options)
    (_, sd), (_, spread) = verdict.moments(), free.moments()
    square = ((free.middle - verdict.middle) ** 2 + spread**2) / sd**2
    trial, num = verdict.measurements.trial, len(candidates)
    size = np.maximum(np.bincount(trial, minlength=num), 1)
    total = np.bincount(trial, square, minlength=num)
    difference = np.sqrt(np.maximum(total / size - 1, 0.0))
    best = int(np.argmax(difference))
    return SevereTest(
        action=candidates[best].double().numpy(),
        is_permitted=is_permitted,
        difference=float(difference[best]),
    )

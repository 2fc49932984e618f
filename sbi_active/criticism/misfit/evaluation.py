"""The error before and after on each left-out trial, the choice repeated without it."""

from __future__ import annotations

import numpy as np

from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.misfit.record import fitted
from sbi_active.criticism.misfit.verdict import Verdict
from sbi_active.criticism.results import OUTLIER, UNEXPLAINED, Evaluation, ModelKey
from sbi_active.criticism.steps.evaluation import joined, scores, summary
from sbi_active.criticism.steps.predictive import NUM_DRAWS, predict
from sbi_active.progress import stage


def evaluate_left_out(
    found: Verdict,
    trials: Trials,
    *,
    num_draws: int = NUM_DRAWS,
    show_progress: bool = False,
) -> Evaluation:
    """Return the error on each trial of models chosen and fitted without it.

    The linearizations are those of all trials; evidence, left-out errors, the choice
    and the refits are made again without each, and the simulator predicts it. Where no
    effect is chosen, nothing is added, and the error stays.

    Args:
        found: Verdict by all trials.
        trials: Trials that were fitted.
        num_draws: Draws from each posterior.
        show_progress: Whether to draw a bar of the trials.
    """
    before, after, selected = [], [], []
    places = np.unique(found.rivals.measurements.trial)
    with stage(
        "error before and after, a verdict without each trial",
        show_progress=show_progress,
        count=lambda: (len(selected), len(places)),
    ):
        for place, own in zip(places, found.search.errors.trials, strict=True):
            one = trials.select([int(place)])
            key = found.chosen_by(~own)
            model = ModelKey(key.effects)
            if not key.effects and key.error not in (UNEXPLAINED, OUTLIER):
                model = key
            scored = {}
            for each in dict.fromkeys((ModelKey(), model)):
                fit = fitted(found, each, ~own)
                prediction = predict(found.rivals, one, fit=fit, num_draws=num_draws)
                scored[each] = scores(prediction, one)
            before.append(scored[ModelKey()])
            after.append(scored[model])
            named = key.effects and key.error != UNEXPLAINED
            selected.append(
                str(ModelKey(key.effects) if named else ModelKey(error=key.error))
            )
    names = tuple(trials.names[int(i)] for i in places)
    return summary(
        "leave one out", places, joined(before), joined(after), (*selected,), names
    )

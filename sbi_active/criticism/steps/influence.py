r"""Influence of trials on a verdict: its Bayes factor with each one left out.

.. math::
    Z(x_{-k}) = Z(x)\, E_{p(z | x)}\left[\frac{p(x_{-k} | z)}{p(x | z)}\right],

from the weighted sample behind the evidence, which costs no simulation.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sbi_active.arrays import Array
from sbi_active.criticism.results import (
    CATCH_ALLS,
    NONE,
    OUTLIER,
    UNEXPLAINED,
    Evaluation,
    ModelKey,
    Tracing,
)
from sbi_active.criticism.steps.detection import THRESHOLD
from sbi_active.criticism.under_misfit import Misfit

#: Score of trials that speaks against effects.
DENSITY = "log predictive density"


def is_left_to_chance(
    tracing: Tracing,
    *,
    # Odds against a gross error from which one trial may speak for an effect alone.
    decisive: float = 50.0,
) -> bool:
    """Return whether the effects of a verdict may be one trial's gross error.

    This is the case if the verdict falls without the trial that a gross error would be
    in, and the odds of declared effects against such an error are below 50.
    """
    if not tracing.chosen or not tracing.outliers:
        return False
    suspect = next(iter(tracing.outliers))
    p = tracing.probabilities
    declared = sum(v for name, v in p.items() if name not in (NONE, *CATCH_ALLS))
    return suspect in tracing.needed and declared < decisive * p.get(OUTLIER, 0.0)


def unless_refuted(tracing: Tracing, evaluation: Evaluation | None) -> Tracing:
    """Return the tracing, its effects withdrawn where further trials refute them.

    Their squared error is then the larger with the effects, and their density the
    smaller by a Bayes factor of 20. Where every model misses, what was said to predict
    better must lower the errors that are reported: on left-out trials and on held-out
    ones.

    Args:
        tracing: Tracing with the effect that the data point to.
        evaluation: Error before and after on trials that had no part in it.
    """
    if not tracing.chosen:
        return tracing
    if tracing.misfit is not None:
        for where, error in _reported(tracing.misfit, evaluation).items():
            if error[1] >= error[0]:
                made = replace(withdrawn(tracing), refuted=error)
                return replace(made, refuted_on=where)
    if evaluation is None:
        return tracing
    change = evaluation.after[DENSITY] - evaluation.before[DENSITY]
    told = _told(evaluation)
    before, after = _rmse(evaluation, told)
    if after <= before or change[told].sum() >= -THRESHOLD:
        return tracing
    return replace(withdrawn(tracing), refuted=(before, after))


def _reported(
    misfit: Misfit, evaluation: Evaluation | None
) -> dict[str, tuple[float, float]]:
    """Return the errors before and after that a verdict under misfit is told with.

    Of several channels in sensor deviations.
    """
    bare, own = misfit.of(NONE), misfit.of(str(ModelKey(misfit.helps)))
    unit = misfit.sensor if len(misfit.sensor) > 1 else 1.0
    beside = " in sensor deviations" if len(misfit.sensor) > 1 else ""

    def pair(before: Array, after: Array) -> tuple[float, float]:
        first, last = (np.sqrt(np.mean((e / unit) ** 2)) for e in (before, after))
        return float(first), float(last)

    found = {}
    told = None if evaluation is None else _told(evaluation)
    if evaluation is not None and told is not None and not told.all():
        found["the other held-out trials"] = _rmse(evaluation, told)
    elif bare.held_out is not None and own.held_out is not None:
        found[f"held-out trials{beside}"] = pair(bare.held_out, own.held_out)
    left_out = pair(bare.left_out, own.left_out)
    return found | {f"left-out {misfit.left_out}{beside}": left_out}


def _told(evaluation: Evaluation) -> NDArray[np.bool_]:
    """Return the scored trials that tell models apart, (s,).

    A few that no model predicts by far may have gross errors, and the chance by which
    one model is nearer would outweigh all others. Where most are, they are the model's.
    """
    told = np.ones(len(evaluation.trials), bool)
    told[[trial.position for trial in evaluation.missed if trial.by_both]] = False
    return told if 2 * told.sum() >= len(told) else np.ones(len(told), bool)


def _rmse(evaluation: Evaluation, told: NDArray[np.bool_]) -> tuple[float, float]:
    """Return the error before and after, over some of the scored trials."""
    if told.all():
        rmse = evaluation.table.set_index("metric").to_dict("index")["rmse"]
        return rmse["before"], rmse["after"]
    before, after = (
        float(np.sqrt(np.mean(scores["rmse"][told] ** 2)))
        for scores in (evaluation.before, evaluation.after)
    )
    return before, after


def withdrawn(tracing: Tracing) -> Tracing:
    """Return the tracing with the effects of the verdict not to be added."""
    p = tracing.probabilities
    outlier, other = p.get(OUTLIER, 0.0), p.get(UNEXPLAINED, 0.0)
    by_chance = is_left_to_chance(tracing) or outlier > other
    misfit = tracing.misfit
    return replace(
        tracing,
        verdict=OUTLIER if by_chance else UNEXPLAINED,
        chosen=(),
        beside=(),
        instead_of=str(ModelKey(tracing.chosen)),
        misfit=None if misfit is None else replace(misfit, helps=(), named=()),
    )

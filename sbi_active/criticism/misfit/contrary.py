"""What speaks against a verdict's effects, and models that the trials refute."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sbi_active.arrays import Array
from sbi_active.criticism.evidence.rival_set import RivalSet
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
from sbi_active.seeding import derive_seed

#: Score of trials that speaks against effects.
DENSITY = "log predictive density"


def is_left_to_chance(tracing: Tracing) -> bool:
    """Return whether the effects of a verdict may be one trial's gross error.

    This is the case if the verdict falls without the trial that a gross error would be
    in, and the odds of declared effects against such an error are below 50.
    """
    if not tracing.chosen or not tracing.outliers:
        return False
    suspect = next(iter(tracing.outliers))
    p = tracing.probabilities
    declared = sum(v for name, v in p.items() if name not in (NONE, *CATCH_ALLS))
    return suspect in tracing.needed and declared < 50 * p.get(OUTLIER, 0.0)


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


def widened(tracing: Tracing, rivals: RivalSet) -> Tracing:
    r"""Return a verdict whose refuted models have draws that know of it.

    The posterior of a model that misses the trials is as narrow as the sensor allows,
    about a wrong place. Draws of one that is behind the verdict's by a Bayes factor of
    20 are spread by the root of the ratio of both chi-squares (Birge), and moved by
    what separates both models' means, :math:`(\bar u_v - \bar u)\, n` with a standard
    normal n for each draw: the verdict's effects, left out, shift what is left.

    Args:
        tracing: Tracing with effects as the verdict.
        rivals: The models, for bounds of priors.

    References:
        Birge, Physical Review 40 (1932), for the ratio.
    """
    best = tracing.evidences.get(str(ModelKey(tracing.chosen)))
    if not tracing.chosen or best is None:
        return tracing
    found = dict(tracing.evidences)
    known = dict(zip(best.names, best.draws.mean(0), strict=True))
    for name, own in tracing.evidences.items():
        near = own.log_evidence > best.log_evidence - THRESHOLD
        if near or own.key.error is not None:
            continue
        ratio = max(own.best_chi_square / max(best.best_chi_square, 1.0), 1.0)
        mean = own.draws.mean(0)
        center = [known.get(n, m) for n, m in zip(own.names, mean, strict=True)]
        rng = np.random.default_rng(derive_seed(rivals.seed, "refuted", name))
        moved = rng.normal(size=(len(own.draws), 1)) * (np.array(center) - mean)
        draws = mean + np.sqrt(ratio) * (own.draws - mean) + moved
        draws = rivals.rival(own.key).coordinates.within(draws)
        found[name] = replace(own, draws=draws, narrow=own.draws)
    estimates = []
    for one in tracing.estimates:
        phi = found[one.name].draws[:, -len(one.mean) :]
        estimates.append(replace(one, mean=phi.mean(0), sd=phi.std(0)))
    return replace(tracing, evidences=found, estimates=(*estimates,))

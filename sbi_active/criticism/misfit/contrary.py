"""Evidence against a verdict: further trials, and a prior that is too narrow."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from sbi_active.arrays import Array
from sbi_active.criticism.contradictions import BoundParameter, Bounds, Misfit
from sbi_active.criticism.forces.library import is_force
from sbi_active.criticism.misfit.verdict import Verdict
from sbi_active.criticism.results import (
    CATCH_ALLS,
    NONE,
    OUTLIER,
    UNEXPLAINED,
    Evaluation,
    ModelKey,
    Tracing,
)
from sbi_active.criticism.rivals.error_models import Whitener
from sbi_active.criticism.rivals.fit import Fit
from sbi_active.criticism.rivals.rival import Rival
from sbi_active.criticism.rivals.rival_set import RivalSet
from sbi_active.criticism.steps.detection import LEVEL, THRESHOLD
from sbi_active.inference.sampling.least_squares import descend

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
    change = (evaluation.after - evaluation.before)[DENSITY].to_numpy()
    told = _told(evaluation)
    before, after = _rmse(evaluation, told)
    if after <= before or change[told].sum() >= -THRESHOLD:
        return tracing
    return replace(withdrawn(tracing), refuted=(before, after))


def _reported(
    misfit: Misfit, evaluation: Evaluation | None
) -> dict[str, tuple[float, float]]:
    """Return the errors before and after that a verdict under misfit is told with.

    Several channels are compared in sensor deviations.
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
    told = np.ones(len(evaluation.names), bool)
    told[[trial.position for trial in evaluation.missed if trial.by_both]] = False
    return told if 2 * told.sum() >= len(told) else np.ones(len(told), bool)


def _rmse(evaluation: Evaluation, told: NDArray[np.bool_]) -> tuple[float, float]:
    """Return the error before and after, over some of the scored trials."""
    if told.all():
        return evaluation.rmse
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


def judged(
    found: Verdict,
    rivals: RivalSet,
    tracing: Tracing,
    evaluation: Evaluation | None,
) -> Tracing:
    """Return the tracing, and whether its forces are stand-ins.

    A force is adopted as an explanation only if the chi-square of its model has a tail
    probability of at least .01, and the error on trials that were not used falls. A
    force with which that error rises is withdrawn, and so are effects that a wider
    prior makes up for.

    Args:
        found: The verdict, with its linear models.
        rivals: The models with their posteriors.
        tracing: Tracing with the effects that the data point to.
        evaluation: Error before and after on trials that had no part in it.
    """
    tracing = beyond_bounds(found, rivals, unless_refuted(tracing, evaluation))
    effects = {e.name: e for e in rivals.library}
    if not any(is_force(effects[name]) for name in tracing.chosen):
        return tracing
    if evaluation is not None and evaluation.rmse[1] >= evaluation.rmse[0]:
        return replace(withdrawn(tracing), refuted=evaluation.rmse)
    return replace(tracing, stand_in=(*_reasons(rivals, tracing, evaluation),))


def _reasons(
    rivals: RivalSet, tracing: Tracing, evaluation: Evaluation | None
) -> Iterator[str]:
    if tracing.p_value < LEVEL:
        yield f"its chi-square has p = {tracing.p_value:.2g}"
    if evaluation is not None and evaluation.p_value < LEVEL:
        yield f"that of held-out trials has p = {evaluation.p_value:.2g}"
    if any(name.startswith("free") for name in tracing.chosen):
        yield "its form is free"
    families = [e.family for e in rivals.library if e.name in tracing.chosen]
    if len({*families}) < len(families):
        yield "it takes several forms of one family"
    if tracing.log_process > 1.1:  # it does not explain all
        yield f"a residual process beside it gains {tracing.log_process:.1f} nats"


def beyond_bounds(found: Verdict, rivals: RivalSet, tracing: Tracing) -> Tracing:
    """Return the tracing with the parameters at bounds, and fits with a wider prior.

    Parameters of the bare model and of the verdict's model that lie at a bound are
    fitted again with the bound moved. If the bare model then explains the trials as
    well as the effects of the verdict, which have no Bayes factor of 20 left against
    it, these cannot be told from a prior that is too narrow, and are not named. Neither
    are effects that no permitted action separates from the bare model, whatever its
    prior is.

    Args:
        found: The verdict, with its linear models.
        rivals: The models with their posteriors.
        tracing: Tracing with the effects that the data point to.
    """
    keys, own = {ModelKey(): ModelKey()}, found.states.predicting(tracing.key)
    if tracing.key in rivals.fits:
        keys.setdefault(own, tracing.key)
    fits = {key: found.model(key).u for key in keys}
    sides = {key: _sides(rivals.fits[known]) for key, known in keys.items()}
    if not any(side.any() for side in sides.values()):
        return _unless_none(tracing, Bounds())
    heavy = found.search.heavy
    (last, u), rival = [*fits.items()][-1], rivals.rival(own)
    whiten = rivals.noise.whitener(rival.residual(u[None])[0][0])  # errors may last
    best = _refitted(rivals, rivals.rival(last, heavy=heavy), whiten, [u])
    assert best is not None
    square, bounds, dim = best[1], Bounds(), rival.theta_dim
    spare = max(rival.num_observed - rival.dim, 1)
    for key, side in sides.items():
        if not side.any():
            continue
        rival, point = _moved(rivals.rival(key, heavy=heavy), side), fits[key]
        starts = [point, np.r_[u[:dim], point[dim:]]]
        again = _refitted(rivals, rival, whiten, starts)
        held = _held(rivals, side, rival, again)
        bounds = replace(bounds, parameters=(*bounds.parameters, *held))
        if key != ModelKey() or again is None or not held:
            continue
        if found.search.sensor.has_size:
            rest = rival.residual(again[0][None])[0][0] / found.search.unit
            freedom = max(len(rest) - rival.dim, 1)
            p_value = float(chi2.sf(found.states.square(rest), freedom))
            bounds = replace(bounds, p_value=p_value)
        if tracing.chosen and again[1] - square < 2 * THRESHOLD * max(
            square / spare, 1.0
        ):
            bounds = replace(bounds, replaces=str(ModelKey(tracing.chosen)))
    return _unless_none(tracing, bounds)


def _unless_none(tracing: Tracing, bounds: Bounds) -> Tracing:
    """Return the tracing without effects that are the bare model's parameters."""
    as_none = frozenset().union(*[g for g in tracing.equivalent if NONE in g])
    if tracing.chosen and as_none.issuperset(tracing.chosen):
        bounds = replace(bounds, replaces=str(ModelKey(tracing.chosen)))
    if bounds.replaces:
        tracing = replace(withdrawn(tracing), verdict=UNEXPLAINED)
    return replace(tracing, bounds=bounds)


def _sides(fit: Fit) -> NDArray[np.int64]:
    """Return at which bound each of theta and phi is in a model, (d,): -1, 1 or 0."""
    c = fit.rival.coordinates
    own = c.num_own
    # Where draws are as wide as misfit asks, some reach any bound.
    u = fit.sample.u if fit.best is None else fit.best[None]
    side = c.sides(u[:, :own])
    # An effect that vanishes at a bound is a weak one, and no prior is too narrow.
    z, null = c.to_z(c.center[None])[0], np.zeros(own, dtype=bool)
    for effect in fit.rival.effects:
        place = c.places[effect.name]
        z[place], null[place] = effect.null_phi(1).double().numpy()[0], True
    ends = np.where(side < 0, c.low[:own], c.high[:own])
    side[null & (np.abs(c.from_z(z[None])[0, :own] - ends) < 1e-6)] = 0
    return side[fit.rival.searched[:own]]


def _moved(rival: Rival, side: NDArray[np.int64]) -> Rival:
    """Return a rival with some of its bounds moved by the width of the prior.

    Half of that still reaches what a prior barely excludes, twice asks too much of the
    simulator. A positive parameter keeps its sign and a tenth of its bound, since a
    simulator may not know what a negative friction is.
    """
    c = rival.coordinates
    zero, width = -c.shift / c.scale, c.high - c.low
    c.low, c.high = c.low.copy(), c.high.copy()
    for k in np.flatnonzero(side):
        end = c.low if side[k] < 0 else c.high
        bound, farthest = end[k], end[k] + side[k] * width[k]
        is_signed = not c.is_log[k] and side[k] * (zero[k] - bound) > 0
        last = zero[k] + 0.1 * (bound - zero[k])
        end[k] = side[k] * min(side[k] * farthest, side[k] * last)
        end[k] = end[k] if is_signed else farthest
    return rival


def _refitted(
    rivals: RivalSet, rival: Rival, whiten: Whitener, starts: Sequence[Array]
) -> tuple[Array, float] | None:
    """Return the best fit of a rival and its squares; None if the simulator has none.

    Without a derivative nothing is fitted again.
    """
    if not rivals.is_smooth:
        return starts[0], np.inf
    given = np.stack(starts), whiten, rivals.step
    try:
        u, cost = descend(rival, *given, 30)
    except (ArithmeticError, RuntimeError, ValueError):
        return None  # a simulator may refuse what its prior excludes
    u = u[np.argmin(cost)]
    return u, float((whiten(rival.residual(u[None])[0][0]) ** 2).sum())


def _held(
    rivals: RivalSet,
    side: NDArray[np.int64],
    rival: Rival,
    again: tuple[Array, float] | None,
) -> list[BoundParameter]:
    """Return the parameters of a model at bounds, and where they are beyond them.

    One that stays inside though its bound was moved is not held by it.
    """
    before, c = rivals.rival(rival.key).coordinates, rival.coordinates
    z = np.full(c.dim, np.nan)
    if again is not None and rivals.is_smooth:
        z = c.to_z(again[0][None])[0]
    names, found = rivals.names_of(rival), []
    for k in np.flatnonzero(side).tolist():
        ends = before.low if side[k] < 0 else before.high
        bound = c.to_z(np.where(np.isfinite(ends), ends, 0.0)[None])[0, k]
        if side[k] * (z[k] - bound) <= 0:
            continue
        found.append(
            BoundParameter(
                name=names[k],
                model=str(rival.key),
                side="lower" if side[k] < 0 else "upper",
                bound=float(bound),
                beyond=float(z[k]),
            )
        )
    return found

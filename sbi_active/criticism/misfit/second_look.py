"""A second look at verdicts whose model misses the trials by more than the sensor."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.evidence.rival_set import RivalSet
from sbi_active.criticism.linear.search import Search
from sbi_active.criticism.misfit.guesses import guess_residual
from sbi_active.criticism.misfit.record import traced, with_intervals
from sbi_active.criticism.misfit.rule import Rule
from sbi_active.criticism.misfit.verdict import Misfit, find_misfit
from sbi_active.criticism.results import (
    SCATTER,
    UNEXPLAINED,
    Detection,
    Estimate,
    Evidence,
    ModelKey,
    Tracing,
)
from sbi_active.criticism.steps.detection import THRESHOLD
from sbi_active.seeding import derive_seed

Array = NDArray[Any]


def beside_misfit(
    tracing: Tracing,
    detection: Detection,
    rivals: RivalSet,
    equivalent: Sequence[frozenset[str]],
    held_out: Trials | None,
    search: Search | None,
    rule: Rule,
) -> tuple[Tracing, Misfit | None]:
    """Return a verdict by models with a residual process, where none explains.

    Along a trajectory it takes the place of any other. Of numbers without a time axis
    it is asked for several effects as well, which fit much that was not declared; it
    takes the place where it says more, and else gives the intervals.

    Args:
        tracing: The verdict by the sensor's error, or one of unknown size.
        detection: Detection that it follows.
        rivals: The models.
        equivalent: Groups of effects that nothing separates.
        held_out: Trials on which models are scored; None for none.
        search: Fits the models; None if the error of the sensor is not known.
        rule: Rule that decides which effects help.

    Returns:
        The verdict, and the models if it is theirs.
    """
    misfit, timed = None, rivals.measurements.is_sequence
    several = len(tracing.chosen) > 1 and not timed
    if _is_missed(tracing, detection, rivals, rule) or several:
        # It is no error of a sensor: a process that follows the action is.
        misfit = find_misfit(search, equivalent, is_known=True, rule=rule)
    is_bare = tracing.verdict == UNEXPLAINED and not tracing.chosen
    can_guess = search is not None and (search.sensor.is_known or not timed)
    if search and is_bare and can_guess and (misfit is None or not timed):
        tracing = replace(tracing, guesses=guess_residual(search))
    if misfit is None:
        return widened(tracing, rivals.seed, _within(rivals)), None
    if not timed and not misfit.replaces(tracing.verdict):
        return with_intervals(tracing, misfit), None
    rivals.fits.clear()
    found = traced(misfit, held_out)
    if found.verdict == UNEXPLAINED and not timed:
        found = replace(found, guesses=tracing.guesses)
    return found, misfit


def _within(rivals: RivalSet) -> Callable[[ModelKey, Array], Array]:
    """Return a function that moves draws of a model into the bounds of its prior."""
    return lambda key, z: rivals.rival(key).coordinates.within(z)


def _is_missed(
    tracing: Tracing, detection: Detection, rivals: RivalSet, rule: Rule
) -> bool:
    """Return whether the model of a verdict misses the trials nevertheless."""
    if tracing.verdict in (UNEXPLAINED, SCATTER):
        return True
    if not tracing.chosen or rivals.measurements.is_sequence:
        return False
    if any(e.hook == "noise" for e in rivals.effects.values()):  # that it may be
        return False
    evidence = rivals.fit(ModelKey(tracing.chosen)).evidence
    return detection.refutes(evidence, rule.passes)


def widened(
    tracing: Tracing, seed: int, within: Callable[[ModelKey, Array], Array]
) -> Tracing:
    r"""Return a verdict whose refuted models have draws that know of it.

    The posterior of a model that misses the trials is as narrow as the sensor allows,
    about a wrong place. Draws of one that is behind the verdict's by a Bayes factor of
    20 are spread by the root of the ratio of both chi-squares (Birge), and moved by
    what separates both models' means, :math:`(\bar u_v - \bar u)\, n` with a standard
    normal n for each draw: the verdict's effects, left out, shift what is left.

    Args:
        tracing: Tracing with effects as the verdict.
        seed: Seed of the draws.
        within: Moves draws of a model, shape (n, k), into the bounds of its prior.

    References:
        Birge, Physical Review 40 (1932), for the ratio.
    """
    best = tracing.evidences.get(str(ModelKey(tracing.chosen)))
    if not tracing.chosen or best is None:
        return tracing
    found = dict(tracing.evidences)
    for name, own in found.items():
        near = own.log_evidence > best.log_evidence - THRESHOLD
        if near or own.key.error is not None:
            continue
        draws = _widened(own, best, derive_seed(seed, "refuted", name))
        draws = within(own.key, draws)
        found[name] = replace(own, draws=draws, narrow=own.draws)
    estimates = [_estimate(e, found[e.name].draws) for e in tracing.estimates]
    return replace(tracing, evidences=found, estimates=(*estimates,))


def _estimate(estimate: Estimate, draws: Array) -> Estimate:
    """Return an effect's estimate by the draws of the model that has it alone."""
    phi = draws[:, -len(estimate.mean) :]
    return replace(estimate, mean=phi.mean(0), sd=phi.std(0))


def _widened(own: Evidence, best: Evidence, seed: int) -> Array:
    ratio = own.best_chi_square / max(best.best_chi_square, 1.0)
    mean = own.draws.mean(0)
    known = dict(zip(best.names, best.draws.mean(0), strict=True))
    apart = np.array([known.get(n, m) for n, m in zip(own.names, mean, strict=True)])
    normal = np.random.default_rng(seed).normal(size=(len(own.draws), 1))
    spread = np.sqrt(max(ratio, 1.0)) * (own.draws - mean)
    return mean + spread + normal * (apart - mean)

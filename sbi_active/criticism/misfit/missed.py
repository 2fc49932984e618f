"""A second look at verdicts whose model misses the trials by more than the sensor."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from numpy.typing import NDArray

from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.evidence.rival_set import RivalSet
from sbi_active.criticism.linear.search import Search
from sbi_active.criticism.misfit.guesses import guess_residual
from sbi_active.criticism.misfit.record import traced, with_intervals
from sbi_active.criticism.misfit.refuted import widened
from sbi_active.criticism.misfit.rule import Rule
from sbi_active.criticism.misfit.verdict import Misfit, find_misfit
from sbi_active.criticism.results import (
    SCATTER,
    UNEXPLAINED,
    Detection,
    ModelKey,
    Tracing,
)

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
    if is_bare and search is not None and (misfit is None or not timed):
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

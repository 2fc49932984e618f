"""Cautions that limit the conclusions of a report: conditions, with a sentence each."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from scipy.stats import rankdata

from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.effects.effect import Effect
from sbi_active.criticism.evidence.rival_set import FEW_TRIALS
from sbi_active.criticism.forces.library import COUPLING, FAMILY
from sbi_active.criticism.report.contents import Contents
from sbi_active.criticism.report.summary import (
    NO_PART,
    narrow_prior,
    rests,
    suspects_in_words,
)
from sbi_active.criticism.report.words import caution, number
from sbi_active.criticism.results import (
    FEW_DRAWS,
    NONE,
    OUTLIER,
    SCATTER,
    UNEXPLAINED,
    Array,
    ModelKey,
    Residuals,
    Tracing,
)
from sbi_active.criticism.rivals.validity import surprising_outcomes
from sbi_active.criticism.steps.detection import REFUTED, TOO_SMALL
from sbi_active.messages import Message
from sbi_active.seeding import forked_generators
from sbi_active.simulation.conditions import parameters_of


def cautions(
    report: Contents, trials: Trials, *, designed: bool = False
) -> tuple[Message, ...]:
    """Return the cautions that limit the conclusions, a sentence each.

    Args:
        report: Report without them.
        trials: The measured trials.
        designed: Actions were chosen for their information.
    """
    found = [
        *_of_trials(report, trials.fit, designed=designed),
        *_of_models(report),
        *_of_verdict(report),
    ]
    said = [caution(code, *values) for code, holds, *values in found if holds]
    return (*map(Message, dict.fromkeys([*said, *_withdrawn(report.tracing)])),)


#: Code of a caution, whether it is said, and the values in its text.
Case = tuple[Any, ...]


def _of_trials(report: Contents, trials: Trials, *, designed: bool) -> Iterator[Case]:
    num, tracing = int(trials.valid.sum()), report.tracing
    is_ordered = trials.order == "known"
    is_sorted = is_ordered and not trials.action_is_label and _aliased(trials)
    is_estimated = report.residuals.noise == "estimated" and tracing.misfit is None
    growth = report.growth if is_ordered else None
    yield "SA501", is_estimated
    yield "SA502", num < FEW_TRIALS, FEW_TRIALS, num
    yield "SA503", is_sorted
    yield "SA504", designed
    yield "SA529", growth, growth
    own = report.residuals
    if report.residuals_after is not None and tracing.chosen:
        own = report.residuals_after
    kinds = [
        "gave no measurement where the model is sure of one",
        "gave a measurement where the model is sure of none",
    ]
    disagreeing = [
        f"trial{'s' * (len(which) > 1)} {', '.join(map(own.called, which))} {what}"
        for which, what in zip(surprising_outcomes(own), kinds, strict=True)
        if which
    ]
    yield "SA505", disagreeing, " and ".join(disagreeing)
    if own.roughness is not None:
        rough = own.roughness[own.roughness > 0]
        yield "SA506", True, rough.min(), rough.max()
    correlation, is_timed = _correlation(own), own.times is not None
    remedy = "GaussianNoise or AutocorrelatedNoise" if is_timed else "sample_times"
    yield "SA507", correlation, correlation, remedy
    for trial in tracing.set_aside:
        yield "SA513", True, trial.name, trial.times, "it is set aside"
    for trial in () if report.evaluation is None else report.evaluation.missed:
        how = f"missed by {number(trial.size)} {trial.unit}"
        if math.isinf(trial.size):
            how = "measured where the model is sure of no measurement"
        yield "SA514", True, trial, how


def _of_models(report: Contents) -> Iterator[Case]:
    tracing, detection = report.tracing, report.detection
    weak = [
        f"{e.name} ({e.effective_sample_size:.0f} effective samples, {e.engine}, "
        f"+- {e.standard_error:.2g} nats)"
        for name, e in tracing.evidences.items()
        if (name in (NONE, tracing.model) or tracing.probabilities.get(name, 0) > 0.01)
        and (e.effective_sample_size < FEW_DRAWS or e.standard_error > 0.5)
    ]
    yield "SA508", weak, ", ".join(weak)
    yield "SA509", detection.alarm and not detection.by_evidence
    misses = tracing.chosen and tracing.misfit is None and tracing.p_value < REFUTED
    yield "SA510", misses, tracing
    if detection.lower_p_value <= TOO_SMALL:
        variance = abs(detection.chi_square / detection.degrees_of_freedom)
        yield "SA523", True, variance**0.5
    for p in tracing.bounds.parameters:
        where = "in the bare model" if p.model == NONE else f"with {p.model}"
        moved = f" with the bound moved the best fit has {p.beyond:.3g};"
        yield "SA103", True, p, where, "" if math.isnan(p.beyond) else moved
    edge = _at_edge(tracing, getattr(report.prior, "effects", ()))
    yield "SA515", edge, ", ".join(effect.name for effect, _ in edge)
    for effect, phi in edge:
        # Families that blame an instrument, beside those on what is observed.
        blames = effect.hook == "observation" or effect.family in ("sensor", "geometry")
        size = f"{number(float(phi[np.argmax(np.abs(phi))]))} {effect.units}".strip()
        yield "SA516", blames, effect.name, size


def _of_verdict(report: Contents) -> Iterator[Case]:
    tracing, verdict = report.tracing, report.verdict
    if tracing.chosen and report.evaluation is not None:
        before, after = report.rmse
        model = ModelKey(tracing.chosen)
        yield "SA512", after >= before, model, NO_PART, before, after
    yield "SA521", verdict == OUTLIER, suspects_in_words(tracing)
    decides = not tracing.instead_of and len(tracing.needed) == 1
    yield "SA522", decides, verdict, rests(tracing)
    yield "SA517", not tracing.robust
    is_left = verdict == UNEXPLAINED
    names_none = is_left and not tracing.chosen and not tracing.bounds.replaces
    yield "SA518", names_none
    # What is left may be a force where the simulator takes forces, and none was tried.
    is_left |= tracing.misfit is not None and not tracing.misfit.passes
    is_tried = any(e.family.startswith((FAMILY, COUPLING)) for e in tracing.estimates)
    if is_left and not is_tried:
        taken = [p.name for p in parameters_of(report.simulator.fn)]
        yield "SA530", "force" in taken
    yield "SA519", verdict == SCATTER
    yield "SA520", report.exploratory


def _withdrawn(tracing: Tracing) -> Iterator[str]:
    """Yield why effects are not named, where that is so."""
    if not tracing.instead_of:
        return
    p = tracing.probabilities.get(tracing.instead_of)
    share = "" if p is None else f" (probability {p:.2g})"
    if tracing.bounds.replaces:
        code, why = "SA103", narrow_prior(tracing)
    elif tracing.refuted:
        where = tracing.refuted_on or NO_PART
        code, _, why = caution("SA512", "it", where, *tracing.refuted).partition(" ")
    else:
        which = f"it {rests(tracing)}, and " if tracing.needed else ""
        code, why = "SA521", f"{which}{suspects_in_words(tracing)} may as well have a "
        why += "gross error: repeat its action before adding it"
    yield f"{code} {tracing.instead_of}{share} is not named, since {why}"


def _aliased(trials: Trials, *, limit: float = 0.9) -> bool:
    """Return whether an entry of the action goes with the order of execution."""
    order = rankdata(trials.index.numpy())
    return any(
        len(value) > 2
        and np.ptp(value) > 0
        and abs(np.corrcoef(order, rankdata(value))[0, 1]) > limit
        for value in trials.action.numpy().T
    )


def _correlation(own: Residuals, *, long: int = 10, least: float = 0.3) -> float:
    """Return that of neighbors in x's first axis; 0 where it is no reason to warn.

    Args:
        own: Residuals, standardized.
        long: Entries a trial of x that may be a trajectory.
        least: Correlation that is one; so are four of its standard errors.
    """
    z = own.refitted
    is_declared = own.times is not None and own.correlation != 0.0
    pairs = np.stack([z[:, :-1].ravel(), z[:, 1:].ravel()])
    pairs = pairs[:, np.isfinite(pairs).all(0)]
    num = pairs.shape[1]
    if is_declared or z.shape[1] < long or num < 3 or not pairs.std(1).all():
        return 0.0
    found = float(np.corrcoef(pairs)[0, 1])
    return found if found > max(least, 4 / np.sqrt(num)) else 0.0


def _at_edge(tracing: Tracing, effects: Sequence[Effect]) -> list[tuple[Effect, Array]]:
    """Return effects of the verdict whose phi is at its edge given all, and phi."""
    evidence = tracing.evidences.get(tracing.model)
    found = []
    for effect in effects:
        if effect.name in tracing.chosen and evidence is not None:
            columns = [evidence.names.index(name) for name in effect.phi_names]
            phi = evidence.draws[:, columns].mean(0)
            if _is_extreme(effect, phi):
                found.append((effect, phi))
    return found


def _is_extreme(effect: Effect, mean: Array, *, edge: float = 0.99) -> bool:
    """Return whether phi is further from the null than almost all of its prior."""
    with forked_generators(0, "edge"):
        draws = effect.sample(2_000).numpy()
    null = effect.null_phi(1).numpy()[0]
    finite = np.isfinite(null)
    center = np.where(finite, null, 0.0)
    distance, own = np.abs(draws - center), np.abs(mean - center)
    beyond = (own > np.quantile(distance, edge, axis=0)) & finite
    # From an infinite null the far end is the one away from it.
    low, high = np.quantile(draws, [1 - edge, edge], axis=0)
    far = np.where(null > 0, mean < low, mean > high) & ~finite
    return bool((beyond | far).any())

"""Cautions that limit the conclusions of a report: conditions, with a sentence each."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

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
from sbi_active.criticism.report.words import called, number
from sbi_active.criticism.results import (
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

#: Families of effects that blame an instrument, beside those on what is observed.
INSTRUMENTS = ["sensor", "geometry"]


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Limits from which a caution is said; half or twice says more or fewer of them.

    Attributes:
        aliased: Rank correlation of an action with the order of the trials.
        edge: Quantile of an effect's prior beyond which an estimate is at its edge.
        few_samples: Effective samples of an evidence.
        uncertain: Standard error of an evidence, nats.
        negligible: Probability of a model whose evidence does not matter.
        long: Entries a trial of x that may be a trajectory.
        correlated: Correlation of neighboring residuals.
        significant: Standard errors of that correlation.
    """

    aliased: float = 0.9
    edge: float = 0.99
    few_samples: int = 50
    uncertain: float = 0.5
    negligible: float = 0.01
    long: int = 10
    correlated: float = 0.3
    significant: float = 4.0


LIMITS = Limits()


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
        *_of_outcomes(report),
        *_of_evidence(report),
        *_of_misses(report),
        *_of_verdict(report),
        *_of_phi(report),
    ]
    return (*map(Message, dict.fromkeys(found)),)


def _of_trials(report: Contents, trials: Trials, *, designed: bool) -> Iterator[str]:
    num = int(trials.valid.sum())
    if report.residuals.noise == "estimated" and report.tracing.misfit is None:
        yield "SA501 noise undeclared: what differs by repeat passes for noise"
    if num < FEW_TRIALS:
        yield f"SA502 fewer than {FEW_TRIALS} trials ({num})"
    is_ordered = trials.order == "known"
    if is_ordered and not trials.action_is_label and _aliased(trials):
        yield "SA503 drift aliased with the order of actions, which were sorted"
    if designed:
        yield "SA504 actions chosen for information and not for deployment"
    if is_ordered and (growth := report.growth):
        yield (
            f"SA529 residuals grow from trial to trial, {growth:.2g} times from the "
            "first third to the last: a parameter may differ by trial; declare it as "
            'an effect of scope "trial", or what drifts'
        )


def _of_outcomes(report: Contents) -> Iterator[str]:
    own = report.residuals
    if report.residuals_after is not None and report.tracing.chosen:
        own = report.residuals_after
    kinds = [
        "gave no measurement where the model is sure of one",
        "gave a measurement where the model is sure of none",
    ]
    disagreeing = [
        f"trial{'s' * (len(which) > 1)} "
        f"{', '.join(called(own.names, i) for i in which)} {what}"
        for which, what in zip(surprising_outcomes(own), kinds, strict=True)
        if which
    ]
    if disagreeing:
        yield f"SA505 outcomes that disagree: {' and '.join(disagreeing)}"
    if own.roughness is not None:
        rough = own.roughness[own.roughness > 0]
        yield (
            f"SA506 the simulator jumps: x strays by {rough.min():.2g} to "
            f"{rough.max():.2g} from a smooth function of the parameters, which "
            "counts as an error beside the noise"
        )
    if correlation := _correlation(own):
        is_timed = own.times is not None
        remedy = "GaussianNoise or AutocorrelatedNoise" if is_timed else "sample_times"
        yield (
            "SA507 independent errors forced on a trajectory: neighboring residuals "
            f"correlate by {correlation:.2f}; declare {remedy}"
        )


def _of_evidence(report: Contents) -> Iterator[str]:
    tracing, detection = report.tracing, report.detection
    matter = {NONE, tracing.model}
    matter |= {n for n, p in tracing.probabilities.items() if p > LIMITS.negligible}
    weak = [
        f"{e.name} ({e.effective_sample_size:.0f} effective samples, {e.engine}, "
        f"+- {e.standard_error:.2g} nats)"
        for name, e in tracing.evidences.items()
        if name in matter
        and (
            e.effective_sample_size < LIMITS.few_samples
            or e.standard_error > LIMITS.uncertain
        )
    ]
    if weak:
        yield f"SA508 evidence uncertain of {', '.join(weak)}"
    if detection.alarm and not detection.by_evidence:
        yield "SA509 the alarm rests on the chi-square alone: a cause is a suggestion"
    if tracing.chosen and tracing.misfit is None and tracing.p_value < REFUTED:
        yield (
            f"SA510 {tracing.verdict} explains the most, and not all: its chi-square "
            f"has p < {REFUTED:g}, so that something else is missing too"
        )
    if detection.lower_p_value <= TOO_SMALL:
        small = abs(detection.least_chi_square / detection.degrees_of_freedom) ** 0.5
        yield (
            "SA523 residuals are far smaller than the declared noise allows, "
            f"{small:.2g} of its standard deviation: declare the error of the "
            "measurement in the unit of x"
        )


def _of_misses(report: Contents) -> Iterator[str]:
    """Yield sentences on trials far off, and on parameters at bounds, one each."""
    evaluation, tracing = report.evaluation, report.tracing
    for trial in tracing.set_aside:
        yield (
            f"SA513 trial {trial.name} is far outside what the other trials show, "
            f"{trial.times:.3g} times their error: it is set aside; check its record"
        )
    for trial in () if evaluation is None else evaluation.missed:
        how = f"missed by {number(trial.size)} {trial.unit}"
        if math.isinf(trial.size):
            how = "measured where the model is sure of no measurement"
        yield (
            f"SA514 held-out trial {trial.name} is far outside what the verdict's "
            f"model predicts, {how}: check its record and its unit"
        )
    for p in tracing.bounds.parameters:
        where = "in the bare model" if p.model == NONE else f"with {p.model}"
        moved = f" with the bound moved the best fit has {p.beyond:.3g};"
        yield (
            f"SA103 {p.name} is at a bound of its prior {where}, the {p.side} one "
            f"({p.bound:.6g});{'' if math.isnan(p.beyond) else moved} move the bound, "
            "or say why"
        )


def _of_verdict(report: Contents) -> Iterator[str]:
    tracing, verdict = report.tracing, report.verdict
    if tracing.chosen and report.evaluation is not None:
        before, after = report.rmse
        if after >= before:
            yield f"SA512 {_no_better(str(ModelKey(tracing.chosen)), before, after)}"
    if verdict == OUTLIER:
        yield (
            f"SA521 {suspects_in_words(tracing)} does not agree with the others: check "
            "its record, then correct, withdraw or repeat it"
        )
    if tracing.instead_of:
        code, why = _withdrawn(tracing)
        p = tracing.probabilities.get(tracing.instead_of)
        share = "" if p is None else f" (probability {p:.2g})"
        yield f"{code} {tracing.instead_of}{share} is not named, {why}"
    elif len(tracing.needed) == 1:
        yield (
            f"SA522 {verdict} {rests(tracing)}: without it the Bayes factor against "
            "the bare model is below 20"
        )
    if not tracing.robust:
        yield "SA517 not robust to its prior"
    if verdict == UNEXPLAINED and not tracing.chosen and not tracing.bounds.replaces:
        yield (
            "SA518 no declared effect explains the data, and what stands in its place "
            "does not extrapolate"
        )
    if _may_be_force(report):
        yield (
            "SA530 what is left may be a force: add those of force_effects to the "
            "effects"
        )
    if verdict == SCATTER:
        yield "SA519 scatter is larger than the declared noise, which is no cause"
    if report.exploratory:
        yield "SA520 exploratory: changed after the data were seen"


def _no_better(which: str, before: float, after: float, on: str = NO_PART) -> str:
    return (
        f"{which} does not lower the error on {on}: RMSE {before:.3g} before and "
        f"{after:.3g} after"
    )


def _withdrawn(tracing: Tracing) -> tuple[str, str]:
    """Return code and reason for which effects are not named."""
    if tracing.bounds.replaces:
        return "SA103", f"since {narrow_prior(tracing)}"
    if tracing.refuted:
        where = tracing.refuted_on or NO_PART
        return "SA512", f"since {_no_better('it', *tracing.refuted, where)}"
    which = f"it {rests(tracing)}, and " if tracing.needed else ""
    return "SA521", (
        f"since {which}{suspects_in_words(tracing)} may as well have a gross error: "
        "repeat its action before adding it"
    )


def _of_phi(report: Contents) -> Iterator[str]:
    edge = _at_edge(report.tracing, getattr(report.prior, "effects", ()))
    if edge:
        names = ", ".join(effect.name for effect, _ in edge)
        yield (
            f"SA515 phi at its prior's edge ({names}): it is stronger than declared, "
            "or stands in for another"
        )
    for effect, phi in edge:
        size = f"{number(float(phi[np.argmax(np.abs(phi))]))} {effect.units}".strip()
        if effect.hook == "observation" or effect.family in INSTRUMENTS:
            yield f"SA516 {effect.name} of {size} is more than an instrument gets wrong"


def _aliased(trials: Trials) -> bool:
    """Return whether an entry of the action goes with the order of execution."""
    order = rankdata(trials.index.numpy())
    return any(
        len(value) > 2
        and np.ptp(value) > 0
        and abs(np.corrcoef(order, rankdata(value))[0, 1]) > LIMITS.aliased
        for value in trials.action.numpy().T
    )


def _may_be_force(report: Contents) -> bool:
    """Return whether something is left, and a simulator that takes forces has none."""
    misfit = report.tracing.misfit
    is_left = report.verdict == UNEXPLAINED or misfit is not None and not misfit.passes
    families = [e.family for e in report.tracing.estimates]
    if not is_left or any(f.startswith((FAMILY, COUPLING)) for f in families):
        return False
    return "force" in [p.name for p in parameters_of(report.simulator.fn)]


def _correlation(own: Residuals) -> float:
    """Return that of neighbors in x's first axis; 0 where it is no reason to warn."""
    z = own.refitted
    is_declared = own.times is not None and own.correlation != 0.0
    pairs = np.stack([z[:, :-1].ravel(), z[:, 1:].ravel()])
    pairs = pairs[:, np.isfinite(pairs).all(0)]
    num = pairs.shape[1]
    if is_declared or z.shape[1] < LIMITS.long or num < 3 or not pairs.std(1).all():
        return 0.0
    found = float(np.corrcoef(pairs)[0, 1])
    least = max(LIMITS.correlated, LIMITS.significant / np.sqrt(num))
    return found if found > least else 0.0


def _at_edge(tracing: Tracing, effects: Sequence[Effect]) -> list[tuple[Effect, Array]]:
    """Return effects of the verdict whose phi is at its edge given all, and phi."""
    evidence = tracing.evidences.get(tracing.model)
    if evidence is None:
        return []
    found = []
    for effect in effects:
        if effect.name in tracing.chosen:
            columns = [evidence.names.index(name) for name in effect.phi_names]
            phi = evidence.draws[:, columns].mean(0)
            if _is_extreme(effect, phi):
                found.append((effect, phi))
    return found


def _is_extreme(effect: Effect, mean: Array) -> bool:
    """Return whether phi is further from the null than almost all of its prior."""
    with forked_generators(0, "edge"):
        draws = effect.sample(2_000).numpy()
    null = effect.null_phi(1).numpy()[0]
    finite = np.isfinite(null)
    center = np.where(finite, null, 0.0)
    distance, own = np.abs(draws - center), np.abs(mean - center)
    beyond = (own > np.quantile(distance, LIMITS.edge, axis=0)) & finite
    # From an infinite null the far end is the one away from it.
    low, high = np.quantile(draws, [1 - LIMITS.edge, LIMITS.edge], axis=0)
    far = np.where(null > 0, mean < low, mean > high) & ~finite
    return bool((beyond | far).any())

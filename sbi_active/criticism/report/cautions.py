"""Cautions that limit the conclusions of a report: conditions, with a sentence each."""

from __future__ import annotations

import math
from collections.abc import Sequence
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
from sbi_active.simulation.signatures import parameters_of

#: A condition, and the sentence that is said where it holds.
Row = tuple[object, str]

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
        disagreement: Difference of two estimates of the bare model's evidence, nats.
        long: Entries a trial of x that may be a trajectory.
        correlated: Correlation of neighboring residuals.
        significant: Standard errors of that correlation.
    """

    aliased: float = 0.9
    edge: float = 0.99
    few_samples: int = 50
    uncertain: float = 0.5
    negligible: float = 0.01
    disagreement: float = 1.0
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
    rows = [
        *_of_trials(report, trials.fit, designed=designed),
        *_of_outcomes(report),
        *_of_evidence(report),
        *_of_misses(report),
        *_of_verdict(report),
        *_of_phi(report),
    ]
    found = dict.fromkeys(sentence for holds, sentence in rows if holds)
    return (*map(Message, found),)


def _of_trials(report: Contents, trials: Trials, *, designed: bool) -> list[Row]:
    num = int(trials.valid.sum())
    estimated = report.residuals.noise == "estimated" and report.tracing.misfit is None
    in_order = trials.order == "known" and not trials.action_is_label
    growth = report.growth if trials.order == "known" else None
    grown = f"{growth or 0:.2g} times from the first third to the last"
    return [
        (estimated, "SA501 noise undeclared: what differs by repeat passes for noise"),
        (num < FEW_TRIALS, f"SA502 fewer than {FEW_TRIALS} trials ({num})"),
        (
            in_order and _aliased(trials),
            "SA503 drift aliased with the order of actions, which were sorted",
        ),
        (designed, "SA504 actions chosen for information and not for deployment"),
        (
            growth,
            f"SA529 residuals grow from trial to trial, {grown}: a parameter may "
            'differ by trial; declare it as an effect of scope "trial", or what drifts',
        ),
    ]


def _of_outcomes(report: Contents) -> list[Row]:
    own = report.residuals
    if report.residuals_after is not None and report.tracing.chosen:
        own = report.residuals_after
    disagreeing = [
        f"trial{'s' * (len(which) > 1)} "
        f"{', '.join(called(own.names, i) for i in which)} {what}"
        for which, what in zip(
            surprising_outcomes(own),
            [
                "gave no measurement where the model is sure of one",
                "gave a measurement where the model is sure of none",
            ],
            strict=True,
        )
        if which
    ]
    rough = np.zeros(1) if own.roughness is None else own.roughness[own.roughness > 0]
    strays = f"{rough.min():.2g} to {rough.max():.2g}"
    correlation = _correlation(own)
    remedy = "sample_times"
    if own.times is not None:
        remedy = "GaussianNoise or AutocorrelatedNoise"
    return [
        (disagreeing, f"SA505 outcomes that disagree: {' and '.join(disagreeing)}"),
        (
            own.roughness is not None,
            f"SA506 the simulator jumps: x strays by {strays} from a smooth function "
            "of the parameters, which counts as an error beside the noise",
        ),
        (
            correlation,
            "SA507 independent errors forced on a trajectory: neighboring residuals "
            f"correlate by {correlation:.2f}; declare {remedy}",
        ),
    ]


def _of_evidence(report: Contents) -> list[Row]:
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
    remains = tracing.chosen and tracing.misfit is None
    check = detection.null_cross_check
    apart = 0.0 if check is None else abs(check - detection.null_log_evidence)
    small = abs(detection.least_chi_square / detection.degrees_of_freedom) ** 0.5
    return [
        (weak, f"SA508 evidence uncertain of {', '.join(weak)}"),
        (
            detection.alarm and not detection.by_evidence,
            "SA509 the alarm rests on the chi-square alone: a cause is a suggestion",
        ),
        (
            remains and detection.refutes(tracing.evidences[tracing.verdict], REFUTED),
            f"SA510 {tracing.verdict} explains the most, and not all: its chi-square "
            f"has p < {REFUTED:g}, so that something else is missing too",
        ),
        (
            apart > LIMITS.disagreement,
            f"SA511 two estimates of the bare model's evidence differ by {apart:.1f} "
            "nats",
        ),
        (
            detection.lower_p_value <= TOO_SMALL,
            "SA523 residuals are far smaller than the declared noise allows, "
            f"{small:.2g} of its standard deviation: declare the error of the "
            "measurement in the unit of x",
        ),
    ]


def _of_misses(report: Contents) -> list[Row]:
    """Return rows of trials far off, and of parameters at bounds, one each."""
    evaluation, tracing = report.evaluation, report.tracing
    rows: list[Row] = [
        (
            True,
            f"SA513 trial {trial.name} is far outside what the other trials show, "
            f"{trial.times:.3g} times their error: it is set aside; check its record",
        )
        for trial in tracing.set_aside
    ]
    for trial in () if evaluation is None else evaluation.missed:
        how = f"missed by {number(trial.size)} {trial.unit}"
        if math.isinf(trial.size):
            how = "measured where the model is sure of no measurement"
        sentence = (
            f"SA514 held-out trial {trial.name} is far outside what the verdict's "
            f"model predicts, {how}: check its record and its unit"
        )
        rows.append((True, sentence))
    for p in tracing.bounds.parameters:
        where = "in the bare model" if p.model == NONE else f"with {p.model}"
        moved = f" with the bound moved the best fit has {p.beyond:.3g};"
        sentence = (
            f"SA103 {p.name} is at a bound of its prior {where}, the {p.side} one "
            f"({p.bound:.6g});{'' if math.isnan(p.beyond) else moved} move the bound, "
            "or say why"
        )
        rows.append((True, sentence))
    return rows


def _of_verdict(report: Contents) -> list[Row]:
    tracing, verdict = report.tracing, report.verdict
    before = after = 0.0
    if report.evaluation is not None:
        rmse = report.before_after.set_index("metric").loc["rmse"]
        before, after = float(rmse["before"]), float(rmse["after"])
    is_bare = verdict == UNEXPLAINED and not tracing.chosen
    code, why = _withdrawn(tracing)
    p = tracing.probabilities.get(tracing.instead_of)
    share = "" if p is None else f" (probability {p:.2g})"
    rests_on_one = len(tracing.needed) == 1 and not tracing.instead_of
    return [
        (
            tracing.chosen and report.evaluation is not None and after >= before,
            f"SA512 {ModelKey(tracing.chosen)} does not lower the error on {NO_PART}: "
            f"RMSE {before:.3g} before and {after:.3g} after",
        ),
        (
            verdict == OUTLIER,
            f"SA521 {suspects_in_words(tracing)} does not agree with the others: check "
            "its record, then correct, withdraw or repeat it",
        ),
        (tracing.instead_of, f"{code} {tracing.instead_of}{share} is not named, {why}"),
        (
            rests_on_one,
            f"SA522 {verdict} {rests(tracing) if rests_on_one else ''}: without it the "
            "Bayes factor against the bare model is below 20",
        ),
        (not tracing.robust, "SA517 not robust to its prior"),
        (
            is_bare and not tracing.bounds.replaces,
            "SA518 no declared effect explains the data, and what stands in its place "
            "does not extrapolate",
        ),
        (
            _may_be_force(report),
            "SA530 what is left may be a force: add those of force_effects to the "
            "effects",
        ),
        (
            verdict == SCATTER,
            "SA519 scatter is larger than the declared noise, which is no cause",
        ),
        (report.exploratory, "SA520 exploratory: changed after the data were seen"),
    ]


def _withdrawn(tracing: Tracing) -> tuple[str, str]:
    """Return code and reason for which effects are not named."""
    if tracing.bounds.replaces:
        return "SA103", f"since {narrow_prior(tracing)}"
    if tracing.refuted:
        before, after = tracing.refuted
        where = tracing.refuted_on or NO_PART
        rmse = f"RMSE {before:.3g} before and {after:.3g} after"
        return "SA512", f"since it does not lower the error on {where}: {rmse}"
    which = f"it {rests(tracing)}, and " if tracing.needed else ""
    return "SA521", (
        f"since {which}{suspects_in_words(tracing)} may as well have a gross error: "
        "repeat its action before adding it"
    )


def _of_phi(report: Contents) -> list[Row]:
    edge = _at_edge(report.tracing, getattr(report.prior, "effects", ()))
    names = ", ".join(effect.name for effect, _ in edge)
    rows: list[Row] = [
        (
            edge,
            f"SA515 phi at its prior's edge ({names}): it is stronger than declared, "
            "or stands in for another",
        )
    ]
    for effect, phi in edge:
        size = f"{number(float(phi[np.argmax(np.abs(phi))]))} {effect.units}".strip()
        rows.append(
            (
                effect.hook == "observation" or effect.family in INSTRUMENTS,
                f"SA516 {effect.name} of {size} is more than an instrument gets wrong",
            )
        )
    return rows


def _aliased(trials: Trials) -> bool:
    """Return whether an entry of the action goes with the order of execution."""
    order = rankdata(trials.index.numpy())
    for value in trials.action.numpy().T:
        ranks = rankdata(value)
        varies = len(ranks) > 2 and ranks.std() > 0
        if varies and abs(np.corrcoef(order, ranks)[0, 1]) > LIMITS.aliased:
            return True
    return False


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
    takes_none = own.times is None or own.correlation == 0.0
    first, second = z[:, :-1].ravel(), z[:, 1:].ravel()
    both = np.isfinite(first) & np.isfinite(second)
    first, second = first[both], second[both]
    varies = len(first) > 2 and first.std() > 0 and second.std() > 0
    if not (takes_none and z.shape[1] >= LIMITS.long and varies):
        return 0.0
    found = float(np.corrcoef(first, second)[0, 1])
    return (
        found
        if found > max(LIMITS.correlated, LIMITS.significant / np.sqrt(len(first)))
        else 0.0
    )


def _at_edge(tracing: Tracing, effects: Sequence[Effect]) -> list[tuple[Effect, Array]]:
    """Return effects of the verdict whose phi is at its edge given all, and phi."""
    evidence = tracing.evidences.get(tracing.model)
    if evidence is None:
        return []
    found = []
    for effect in effects:
        if effect.name not in tracing.chosen:
            continue
        columns = [evidence.names.index(name) for name in effect.phi_names]
        phi = evidence.draws[:, columns]
        if _is_extreme(effect, phi):
            found.append((effect, phi.mean(0)))
    return found


def _is_extreme(effect: Effect, phi: Array) -> bool:
    """Return whether phi lies further from the null than almost all of its prior."""
    with forked_generators(0, "edge"):
        draws = effect.sample(2_000).numpy()
    mean, null = phi.mean(0), effect.null_phi(1).numpy()[0]
    finite = np.isfinite(null)
    center = np.where(finite, null, 0.0)
    distance, own = np.abs(draws - center), np.abs(mean - center)
    beyond = (own > np.quantile(distance, LIMITS.edge, axis=0)) & finite
    # From an infinite null the far end is the one away from it.
    low, high = np.quantile(draws, [1 - LIMITS.edge, LIMITS.edge], axis=0)
    far = np.where(null > 0, mean < low, mean > high) & ~finite
    return bool((beyond | far).any())

"""Cautions that limit the conclusions of a report, a sentence each."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import rankdata

from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.effects.effect import Effect
from sbi_active.criticism.evidence.rival_set import FEW_TRIALS
from sbi_active.criticism.report.names import called
from sbi_active.criticism.report.numbers import number
from sbi_active.criticism.report.suspects import (
    of_bounds,
    of_missed,
    of_noise,
    of_outlying,
    of_trials,
)
from sbi_active.criticism.results import (
    NONE,
    SCATTER,
    UNEXPLAINED,
    Detection,
    Evaluation,
    ModelKey,
    Residuals,
    Tracing,
)
from sbi_active.criticism.rivals.validity import surprising_outcomes
from sbi_active.criticism.steps.detection import REFUTED
from sbi_active.messages import Message
from sbi_active.seeding import forked_generators

Array = NDArray[Any]

ALIASED = 0.9  # |rank correlation| of an action with the order of the trials
#: Quantile of an effect's prior beyond which an estimate lies at its edge.
EDGE = 0.99
#: Families of effects that blame an instrument, beside those on what is observed.
INSTRUMENTS = ("sensor", "geometry")
#: Effective samples below which, and standard error in nats above which, an evidence
#: is called uncertain; models below the probability are left out.
FEW_SAMPLES, UNCERTAIN, NEGLIGIBLE = 50, 0.5, 0.01
#: Nats by which two estimates of the bare model's evidence may differ.
DISAGREEMENT = 1.0
#: Entries a trial from which x may be a trajectory, and the correlation of neighboring
#: residuals (and its multiple of 1 / sqrt(N)) from which they are not independent.
LONG, CORRELATED, SIGNIFICANT = 10, 0.3, 4.0


def find_warnings(
    trials: Trials,
    residuals: Residuals,
    tracing: Tracing,
    *,
    detection: Detection | None = None,
    residuals_after: Residuals | None = None,
    evaluation: Evaluation | None = None,
    effects: Sequence[Effect] = (),
    exploratory: bool = False,
    designed: bool = False,
) -> tuple[Message, ...]:
    """Return the cautions that limit the conclusions, a sentence each.

    Args:
        trials: The measured trials.
        residuals: Residuals of the bare model.
        tracing: Tracing with the effect that the data point to.
        detection: Whether the bare model misses the data.
        residuals_after: Residuals with the effects of the verdict.
        evaluation: Error before and after.
        effects: Effects that were added.
        exploratory: Whether what was frozen was changed after the data were seen.
        designed: Actions were chosen for their information.
    """
    found = (
        *_of_trials(
            trials.fit,
            residuals,
            designed=designed,
            has_sensor=tracing.misfit is not None,
        ),
        *_of_errors(residuals, residuals_after, tracing),
        *_of_evidence(tracing, detection),
        *of_noise(detection),
        *of_outlying(tracing),
        *of_missed(evaluation),
        *of_bounds(tracing.bounds),
        *of_trials(tracing),
        *_of_verdict(tracing, effects, evaluation, exploratory=exploratory),
    )
    return (*map(Message, found),)


def _of_trials(
    trials: Trials, residuals: Residuals, *, designed: bool, has_sensor: bool
) -> Iterator[str]:
    if residuals.noise == "estimated" and not has_sensor:
        yield (
            "SA501 noise undeclared: its size has a prior or is estimated from "
            "repeated trials, which show scatter and no bias, and what differs from "
            "repeat to repeat passes for noise"
        )
    num = int(trials.valid.sum())
    if num < FEW_TRIALS:
        yield (
            f"SA502 fewer than {FEW_TRIALS} trials ({num}): several effects may "
            "explain as few"
        )
    if not trials.action_is_label and _aliased(trials):
        yield (
            "SA503 drift aliased with the order of actions: they were executed in "
            "sorted order, so that what grows with time looks like what grows with "
            "the action"
        )
    if designed:
        yield (
            "SA504 actions chosen for information and not for deployment: the error "
            "before and after is that of such actions"
        )


def _of_errors(
    before: Residuals, after: Residuals | None, tracing: Tracing
) -> Iterator[str]:
    own = before if after is None or not tracing.chosen else after
    lost, kept = surprising_outcomes(own)
    if lost or kept:
        yield (
            "SA505 outcomes that disagree: "
            + " and ".join(
                f"trial{'s' * (len(which) > 1)} "
                f"{', '.join(called(own.names, i) for i in which)} {what}"
                for which, what in (
                    (lost, "gave no measurement where the model is sure of one"),
                    (kept, "gave a measurement where the model is sure of none"),
                )
                if which
            )
        )
    if own.roughness is not None:
        rough = own.roughness[own.roughness > 0]
        yield (
            "SA506 the simulator jumps: where parameters change within their "
            f"posterior, x strays by {rough.min():.2g} to {rough.max():.2g} from a "
            "smooth function of them, which counts as an error of its own beside the "
            "noise, so that less is concluded than the trials may hold"
        )
    assumed_independent = own.times is None or own.correlation == 0.0
    if assumed_independent and own.x.shape[1] >= LONG:
        correlation, num = _neighbors(own.refitted)
        if correlation > max(CORRELATED, SIGNIFICANT / np.sqrt(num)):
            advice = (
                "declare sample_times"
                if own.times is None
                else "declare GaussianNoise or AutocorrelatedNoise"
            )
            yield (
                "SA507 independent errors forced on a trajectory: neighboring "
                f"residuals have a correlation of {correlation:.2f}, which makes "
                f"false alarms and intervals that are too narrow; {advice}"
            )


def _of_evidence(tracing: Tracing, detection: Detection | None) -> Iterator[str]:
    matter = {NONE, tracing.model}
    matter |= {n for n, p in tracing.probabilities.items() if p > NEGLIGIBLE}
    weak = [
        f"{e.name} ({e.effective_sample_size:.0f} effective samples, {e.engine}, "
        f"+- {e.standard_error:.2g} nats)"
        for name, e in tracing.evidences.items()
        if name in matter
        and (e.effective_sample_size < FEW_SAMPLES or e.standard_error > UNCERTAIN)
    ]
    if weak:
        yield (
            f"SA508 evidence uncertain of {', '.join(weak)}: so are the probabilities "
            "that rest on it"
        )
    if detection is not None and detection.alarm and not detection.by_evidence:
        yield (
            "SA509 the alarm rests on the chi-square alone: no alternative has a "
            "Bayes factor of 20, so that what is lacking is a suggestion"
        )
    if (
        detection is not None
        and tracing.chosen
        and tracing.misfit is None
        and detection.refutes(tracing.evidences[tracing.verdict], REFUTED)
    ):
        yield (
            f"SA510 {tracing.verdict} explains the most, and not all: the chi-square "
            f"of the trials with it has p < {REFUTED:g}, so that something else is "
            "missing too"
        )
    check = None if detection is None else detection.null_cross_check
    if detection is not None and check is not None:
        difference = check - detection.null_log_evidence
        if abs(difference) > DISAGREEMENT:
            yield (
                "SA511 two estimates of the bare model's evidence differ by "
                f"{abs(difference):.1f} nats: its posterior has parts that one of "
                "them missed"
            )


def _of_verdict(
    tracing: Tracing,
    effects: Sequence[Effect],
    evaluation: Evaluation | None,
    *,
    exploratory: bool,
) -> Iterator[str]:
    if tracing.chosen and evaluation is not None:
        rmse = evaluation.table.set_index("metric").to_dict("index")["rmse"]
        if rmse["after"] >= rmse["before"]:
            yield (
                f"SA512 {ModelKey(tracing.chosen)} does not lower the error on trials "
                f"that had no part in it: RMSE {rmse['before']:.3g} before and "
                f"{rmse['after']:.3g} after"
            )
    edge = _at_edge(tracing, effects)
    if edge:
        yield (
            f"SA515 phi at its prior's edge ({', '.join(e.name for e, _ in edge)}): "
            "the effect is stronger than declared, or stands in for another"
        )
    for effect, phi in edge:
        if effect.hook == "observation" or effect.family in INSTRUMENTS:
            size = f"{number(float(phi[np.argmax(np.abs(phi))]))} {effect.units}"
            yield (
                f"SA516 {effect.name} of {size.strip()} is more than an instrument "
                "gets wrong: it stands in for something else, however well it predicts"
            )
    if not tracing.robust:
        yield (
            "SA517 not robust to its prior: effect priors a third or three times as "
            "wide give another verdict"
        )
    is_bare = tracing.verdict == UNEXPLAINED and not tracing.chosen
    if is_bare and not tracing.bounds.replaces:
        place = (
            f"beside {ModelKey(tracing.beside)}" if tracing.beside else "in its place"
        )
        yield (
            "SA518 no declared effect explains the data: the residual process "
            f"{place} does not extrapolate"
        )
    if tracing.verdict == SCATTER:
        yield "SA519 scatter is larger than the declared noise, which is no cause"
    if exploratory:
        yield (
            "SA520 exploratory: library or priors were changed after the data were "
            "seen, so the false-alarm rate is not what is stated"
        )


def _aliased(trials: Trials) -> bool:
    """Return whether an entry of the action goes with the order of execution."""
    if trials.order == "unknown":
        return False
    order = rankdata(trials.index.numpy())
    for value in trials.action.numpy().T:
        ranks = rankdata(value)
        varies = len(ranks) > 2 and ranks.std() > 0
        if varies and abs(np.corrcoef(order, ranks)[0, 1]) > ALIASED:
            return True
    return False


def _neighbors(z: Array) -> tuple[float, int]:
    """Return the correlation of neighbors along x's first axis, and their number."""
    first, second = z[:, :-1].ravel(), z[:, 1:].ravel()
    both = np.isfinite(first) & np.isfinite(second)
    first, second = first[both], second[both]
    if len(first) < 3 or not (first.std() > 0 and second.std() > 0):
        return 0.0, max(len(first), 1)
    return float(np.corrcoef(first, second)[0, 1]), len(first)


def _at_edge(tracing: Tracing, effects: Sequence[Effect]) -> list[tuple[Effect, Array]]:
    """Return effects of the verdict whose phi is at its edge given all, and phi."""
    evidence = tracing.evidences.get(tracing.model)
    found = []
    for effect in effects if evidence is not None else ():
        if effect.name not in tracing.chosen:
            continue
        assert evidence is not None
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
    beyond = (own > np.quantile(distance, EDGE, axis=0)) & finite
    # From an infinite null the far end is the one away from it.
    low, high = np.quantile(draws, [1 - EDGE, EDGE], axis=0)
    far = np.where(null > 0, mean < low, mean > high) & ~finite
    return bool((beyond | far).any())

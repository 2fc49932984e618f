"""Which effect the data point to: probabilities over the rivals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sbi_active.actions import ActionSpace
from sbi_active.criticism.effects.effect import Effect
from sbi_active.criticism.evidence.rival_set import RivalSet
from sbi_active.criticism.evidence.unknown_scale import log_evidence
from sbi_active.criticism.results import (
    CATCH_ALLS,
    NONE,
    OUTLIER,
    SCATTER,
    UNEXPLAINED,
    Detection,
    Estimate,
    Evidence,
    Tracing,
)
from sbi_active.criticism.steps.coarsening import coarsening
from sbi_active.criticism.steps.combinations import grow
from sbi_active.criticism.steps.detection import REFUTED, THRESHOLD, alternatives
from sbi_active.criticism.steps.equivalence import equivalent_effects
from sbi_active.criticism.steps.gross_errors import gross_errors
from sbi_active.criticism.steps.influence import (
    is_left_to_chance,
    needed_trials,
    withdrawn,
)
from sbi_active.criticism.steps.near_aliases import near_aliases
from sbi_active.inference.sampling.weights import log_sum_exp

__all__ = ["log_priors", "trace"]

Array = NDArray[Any]

PROBABILITY_OF_NONE = 0.5
#: That what is missing, if anything is, is each of the catch-alls.
PROBABILITY_OF_CATCH_ALL = 0.1
MASS = 0.9  # of the credible set
#: Factors on the scale of the effects' priors under which a verdict should stand.
RESCALED = (1 / 3, 3.0)


def log_priors(
    effects: Sequence[Effect], catch_alls: Sequence[str] = CATCH_ALLS
) -> dict[str, float]:
    """Return log prior probabilities of none, each effect and the catch-alls.

    Half is "none". Of the rest the catch-alls have a tenth each, and the families
    share what is left equally.

    Args:
        effects: The declared ones.
        catch_alls: Those that are compared.
    """
    members: dict[str, list[str]] = {}
    for effect in effects:
        members.setdefault(str(effect.family), []).append(effect.name)
    missing = 1 - PROBABILITY_OF_NONE
    each = missing * PROBABILITY_OF_CATCH_ALL
    found = {NONE: PROBABILITY_OF_NONE} | dict.fromkeys(catch_alls, each)
    share = (missing - len(catch_alls) * each) / max(len(members), 1)
    for names in members.values():
        found |= {name: share / len(names) for name in names}
    return {name: float(np.log(p)) for name, p in found.items()}


def trace(
    rivals: RivalSet,
    detection: Detection,
    equivalent: Sequence[frozenset[str]] = (),
    *,
    actions: ActionSpace | None = None,
    compare: bool = True,
) -> Tracing:
    """Return the probabilities of the rivals and the verdict.

    The scales of the effects' priors are unknown. Where every model misses by more than
    the error of measurement, evidence is coarsened
    (:mod:`.coarsening`). After an alarm the verdict is first
    one of: declared effects, "unexplained", "scatter", each with all of its
    probability; then, of the effects, the most probable. Where known noise refutes
    that (its chi-square has p < .001), the residual process is tried beside it: then
    "unexplained" is the process alone or with these effects, half and half. Effects
    that rest on one trial are named only if that trial has hardly a gross error.

    Args:
        rivals: The models.
        detection: Whether there is anything to trace.
        equivalent: Groups that no permitted action separates.
        actions: The permitted ones, for what they hardly separate.
        compare: Whether to look for effects that these trials do not separate.
    """
    # Without an alarm there is no trial to set aside.
    catch_alls = CATCH_ALLS if detection.alarm else (UNEXPLAINED, SCATTER)
    prior = log_priors([*rivals.effects.values()], catch_alls)
    log_z = {NONE: rivals.evidence().log_evidence}
    log_z |= {e: rivals.evidence(error=e).log_evidence for e in catch_alls}
    log_z |= {name: log_evidence(rivals, (name,))[0] for name in rivals.effects}
    log_prior, share = {**prior}, 1.0
    if detection.alarm:
        singles = {name: prior[name] + log_z[name] for name in rivals.effects}
        for name, value in grow(rivals, singles, prior).items():
            log_z[name] = log_evidence(rivals, name.split(" + "))[0]
            log_prior[name] = value - log_z[name]
        share = coarsening(rivals, {n: log_prior[n] + log_z[n] for n in log_z})
    log_p = {name: log_prior[name] + share * log_z[name] for name in log_z}
    probabilities = _normalized(log_p)
    verdict = _verdict(probabilities, equivalent, alarm=detection.alarm)
    beside: tuple[str, ...] = ()
    found = _effects_of(verdict)
    if found and detection.refutes(rivals.evidences[verdict], REFUTED):
        # What takes up most of the misfit need not take up all of it.
        rest = rivals.evidence(found, error=UNEXPLAINED).log_evidence
        alone = log_z[UNEXPLAINED]
        log_z[UNEXPLAINED] = log_sum_exp(np.array([alone, rest])) - float(np.log(2))
        log_p[UNEXPLAINED] = log_prior[UNEXPLAINED] + share * log_z[UNEXPLAINED]
        probabilities = _normalized(log_p)
        verdict = _verdict(probabilities, equivalent, alarm=detection.alarm)
        if verdict == UNEXPLAINED and rest > alone:
            beside = found
    near = equivalent_effects(rivals, None) if compare else ()
    aliases = ()
    if compare and detection.alarm:
        aliases = near_aliases(rivals, actions, [*equivalent, *near])
    chosen = _effects_of(verdict)
    inclusion = {
        name: sum(p for k, p in probabilities.items() if name in k.split(" + "))
        for name in rivals.effects
    }
    tracing = Tracing(
        verdict=verdict,
        chosen=chosen,
        probabilities=probabilities,
        inclusion=inclusion,
        credible_set=_credible_set(probabilities),
        equivalent=(*equivalent,),
        near=near,
        aliases=aliases,
        estimates=_estimates(rivals, inclusion),
        evidences={name: _under_unknown_scale(rivals, name) for name in log_p},
        robust=_is_robust(
            rivals, detection, log_prior, log_z, share, equivalent, verdict
        ),
        coarsening=share,
        beside=beside,
        outliers=gross_errors(rivals) if OUTLIER in log_p else {},
        needed=needed_trials(rivals, chosen) if chosen else (),
    )
    return withdrawn(tracing) if is_left_to_chance(tracing) else tracing


def _normalized(log_p: dict[str, float]) -> dict[str, float]:
    values = np.array([*log_p.values()])
    p = np.exp(values - log_sum_exp(values))
    order = np.argsort(-p, kind="stable")
    names = [*log_p]
    return {names[i]: float(p[i]) for i in order}


def _verdict(
    probabilities: dict[str, float],
    equivalent: Sequence[frozenset[str]],
    *,
    alarm: bool,
) -> str:
    """Return the verdict: the kind of explanation, then the most probable of it.

    Several effects that share the probability do not lose it to a catch-all, and
    equivalent ones count as one.
    """
    if not alarm:
        return NONE
    catch_alls = {n: p for n, p in probabilities.items() if n in CATCH_ALLS}
    declared = 1.0 - probabilities[NONE] - sum(catch_alls.values())
    best = max(catch_alls, key=catch_alls.__getitem__)
    if catch_alls[best] > declared:
        return best
    groups = [group for group in equivalent if NONE not in group]
    classes: dict[frozenset[str], dict[str, float]] = {}
    for name, p in probabilities.items():
        if name in (NONE, *catch_alls):
            continue
        parts = name.split(" + ")
        key = frozenset(
            min(next((g for g in groups if part in g), {part})) for part in parts
        )
        classes.setdefault(key, {})[name] = p
    likeliest = max(classes.values(), key=lambda members: sum(members.values()))
    return max(likeliest, key=likeliest.__getitem__)


def _credible_set(probabilities: dict[str, float]) -> tuple[str, ...]:
    names, total = [], 0.0
    for name, p in probabilities.items():  # most probable first
        names.append(name)
        total += p
        if total >= MASS:
            break
    return (*names,)


def _estimates(rivals: RivalSet, inclusion: dict[str, float]) -> tuple[Estimate, ...]:
    null = rivals.evidence().log_evidence
    found = []
    for name, effect in rivals.effects.items():
        evidence = rivals.evidence((name,))
        phi = evidence.draws[:, -effect.phi_dim :]
        found.append(
            Estimate(
                name=name,
                family=str(effect.family),
                units=effect.units,
                describe=effect.describe or "",
                probability=inclusion[name],
                log_bayes_factor=log_evidence(rivals, (name,))[0] - null,
                mean=phi.mean(0),
                sd=phi.std(0),
                effective_sample_size=evidence.effective_sample_size,
                engine=evidence.engine,
            )
        )
    return (*sorted(found, key=lambda e: -e.probability),)


def _is_robust(
    rivals: RivalSet,
    detection: Detection,
    log_prior: dict[str, float],
    log_z: dict[str, float],
    share: float,
    equivalent: Sequence[frozenset[str]],
    verdict: str,
) -> bool:
    """Return whether priors a third and three times as wide give the same verdict."""
    weights = alternatives([*rivals.effects], equivalent)
    for factor in RESCALED:
        scaled = {**log_z}
        for name in log_z:
            names = _effects_of(name)
            if names:
                scaled[name] = log_evidence(rivals, names, factor=factor)[0]
        singles = np.array([scaled[k] + np.log(w) for k, w in weights.items()])
        log_b = log_sum_exp(singles) - scaled[NONE]
        alarm = bool(log_b > THRESHOLD) or detection.by_chi_square
        log_p = {name: log_prior[name] + share * scaled[name] for name in scaled}
        if _verdict(_normalized(log_p), equivalent, alarm=alarm) != verdict:
            return False
    return True


def _under_unknown_scale(rivals: RivalSet, name: str) -> Evidence:
    """Return a rival's record with the evidence that the probabilities rest on."""
    found = rivals.evidences[name]
    names = _effects_of(name)
    if not names:
        return found
    value, error = log_evidence(rivals, names)
    return replace(found, log_evidence=value, standard_error=error)


def _effects_of(name: str) -> tuple[str, ...]:
    return () if name in (NONE, *CATCH_ALLS) else (*name.split(" + "),)

"""Which effect the data point to: probabilities over the rivals."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
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
    SCATTER,
    UNEXPLAINED,
    Detection,
    Estimate,
    Evidence,
    ModelKey,
    Tracing,
)
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

Array = NDArray[Any]

PROBABILITY_OF_NONE = 0.5  # by convention, neither for nor against
#: That what is missing, if anything is, is each of the catch-alls.
PROBABILITY_OF_CATCH_ALL = 0.1
MASS = 0.9  # of the credible set
#: That an effect beyond the first, beside which a set fits to the sensor's error, is
#: real and imitates nothing; empirical.
REAL = 0.85
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

    The scales of the effects' priors are unknown. After an alarm the verdict is first
    one of: declared effects, "unexplained", "scatter", each with all of its
    probability; then, of the effects, the most probable. Where known noise refutes
    that (its chi-square has p < .001), the residual process is tried beside it: then
    "unexplained" is the process alone or with these effects, half and half. Of what
    several effects of a trajectory explain, it has the share that they may imitate.
    Effects
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
    prior = log_priors(rivals.library, catch_alls)
    names = (NONE, *catch_alls, *rivals.effects)
    log_prior = {ModelKey.of(name): prior[name] for name in names}
    log_z = {key: log_evidence(rivals, key)[0] for key in log_prior}
    process = ModelKey(error=UNEXPLAINED)
    if detection.alarm:
        singles = {n: prior[n] + log_z[ModelKey((n,))] for n in rivals.effects}
        for key, value in grow(rivals, singles, prior).items():
            log_z[key] = log_evidence(rivals, key)[0]
            log_prior[key] = value - log_z[key]
    log_p = {key: log_prior[key] + log_z[key] for key in log_z}
    p = probabilities_of(log_p)
    verdict = _verdict(p, equivalent, alarm=detection.alarm)
    beside: tuple[str, ...] = ()
    found = verdict.effects
    if found and detection.refutes(rivals.fit(verdict).evidence, REFUTED):
        # What takes up most of the misfit need not take up all of it.
        rest = rivals.fit(ModelKey(found, UNEXPLAINED)).evidence.log_evidence
        alone = log_z[process]
        log_z[process] = log_sum_exp(np.array([alone, rest])) - float(np.log(2))
        log_p[process] = log_prior[process] + log_z[process]
        p = probabilities_of(log_p)
        verdict = _verdict(p, equivalent, alarm=detection.alarm)
        if verdict == process and rest > alone:
            beside = found
    p = beside_imitations(p)
    near = equivalent_effects(rivals, None) if compare else ()
    aliases = ()
    if compare and detection.alarm:
        singles = {n: log_z[ModelKey((n,))] for n in rivals.effects}
        aliases = near_aliases(rivals, singles, actions, [*equivalent, *near])
    inclusion = {
        name: sum(share for key, share in p.items() if name in key.effects)
        for name in rivals.effects
    }
    probabilities = {str(key): share for key, share in p.items()}
    tracing = Tracing(
        verdict=str(verdict),
        chosen=verdict.effects,
        probabilities=probabilities,
        inclusion=inclusion,
        credible_set=credible_set(probabilities),
        equivalent=(*equivalent,),
        near=near,
        aliases=aliases,
        estimates=_estimates(rivals, inclusion),
        evidences={str(key): _under_unknown_scale(rivals, key) for key in log_p},
        robust=_is_robust(rivals, detection, log_prior, log_z, equivalent, verdict),
        beside=beside,
        outliers=gross_errors(rivals) if detection.alarm else {},
        needed=needed_trials(rivals, verdict) if verdict.effects else (),
        trial_names=dict(
            zip(rivals.trials.index.tolist(), rivals.trials.names, strict=True)
        ),
    )
    return withdrawn(tracing) if is_left_to_chance(tracing) else tracing


def probabilities_of(log_p: dict[ModelKey, float]) -> dict[ModelKey, float]:
    """Return probabilities from unnormalized logarithms, most probable first."""
    values = np.array([*log_p.values()])
    p = np.exp(values - log_sum_exp(values))
    order = np.argsort(-p, kind="stable")
    keys = [*log_p]
    return {keys[i]: float(p[i]) for i in order}


def beside_imitations(p: dict[ModelKey, float]) -> dict[ModelKey, float]:
    """Return probabilities where a set may owe its fit to something undeclared.

    Along a trajectory two effects imitate a force that nobody declared to the sensor's
    error more often than one: each beyond the first is real with a probability of .85
    (in six such worlds of ``benchmarks/misfit``, none of which judge, 7 of 15 were).
    """
    kept = {k: v * REAL ** max(len(k.effects) - 1, 0) for k, v in p.items()}
    process = ModelKey(error=UNEXPLAINED)
    kept[process] += 1.0 - sum(kept.values())
    return dict(sorted(kept.items(), key=lambda item: -item[1]))


def _verdict(
    probabilities: dict[ModelKey, float],
    equivalent: Sequence[frozenset[str]],
    *,
    alarm: bool,
) -> ModelKey:
    """Return the verdict: the kind of explanation, then the most probable of it.

    Several effects that share the probability do not lose it to a catch-all, and
    equivalent ones count as one.
    """
    if not alarm:
        return ModelKey()
    catch_alls = {k: p for k, p in probabilities.items() if k.error}
    declared = 1.0 - probabilities[ModelKey()] - sum(catch_alls.values())
    best = max(catch_alls, key=catch_alls.__getitem__)
    if catch_alls[best] > declared:
        return best
    groups = [group for group in equivalent if NONE not in group]
    classes: dict[frozenset[str], dict[ModelKey, float]] = {}
    for key, p in probabilities.items():
        if not key.effects:
            continue
        alike = frozenset(
            min(next((g for g in groups if name in g), {name})) for name in key.effects
        )
        classes.setdefault(alike, {})[key] = p
    likeliest = max(classes.values(), key=lambda members: sum(members.values()))
    return max(likeliest, key=likeliest.__getitem__)


def credible_set(probabilities: dict[str, float]) -> tuple[str, ...]:
    """Return the smallest set of names with 90 % of the probability, best first."""
    names, total = [], 0.0
    for name, p in probabilities.items():  # most probable first
        names.append(name)
        total += p
        if total >= MASS:
            break
    return (*names,)


def estimate_of(
    effect: Effect, evidence: Evidence, *, probability: float, log_bayes_factor: float
) -> Estimate:
    """Return an effect's estimate by the draws of the model that has it alone.

    Args:
        effect: Whose phi is the end of the draws.
        evidence: Of that model.
        probability: That the effect is there.
        log_bayes_factor: Of that model against the bare one.
    """
    phi = evidence.draws[:, -effect.phi_dim :]
    return Estimate(
        name=effect.name,
        family=str(effect.family),
        units=effect.units,
        describe=effect.describe or "",
        probability=probability,
        log_bayes_factor=log_bayes_factor,
        mean=phi.mean(0),
        sd=phi.std(0),
        effective_sample_size=evidence.effective_sample_size,
        engine=evidence.engine,
    )


def likeliest_first(estimates: Iterable[Estimate]) -> tuple[Estimate, ...]:
    """Return estimates in the order of their probabilities."""
    return (*sorted(estimates, key=lambda e: -e.probability),)


def _estimates(rivals: RivalSet, inclusion: dict[str, float]) -> tuple[Estimate, ...]:
    null = rivals.fit().evidence.log_evidence
    keys = {name: ModelKey((name,)) for name in rivals.effects}
    return likeliest_first(
        estimate_of(
            effect,
            rivals.fit(keys[name]).evidence,
            probability=inclusion[name],
            log_bayes_factor=log_evidence(rivals, keys[name])[0] - null,
        )
        for name, effect in rivals.effects.items()
    )


def _is_robust(
    rivals: RivalSet,
    detection: Detection,
    log_prior: dict[ModelKey, float],
    log_z: dict[ModelKey, float],
    equivalent: Sequence[frozenset[str]],
    verdict: ModelKey,
) -> bool:
    """Return whether priors a third and three times as wide give the same verdict."""
    every = alternatives([e.name for e in rivals.library], equivalent)
    weights = {k: w for k, w in every.items() if ModelKey.of(k) in log_z}
    for factor in RESCALED:
        scaled = {
            key: log_evidence(rivals, key, factor=factor)[0] if key.effects else value
            for key, value in log_z.items()
        }
        singles = [scaled[ModelKey.of(k)] + np.log(w) for k, w in weights.items()]
        log_b = log_sum_exp(np.array(singles)) - scaled[ModelKey()]
        alarm = bool(log_b > THRESHOLD) or detection.by_chi_square
        log_p = {key: log_prior[key] + scaled[key] for key in scaled}
        if _verdict(probabilities_of(log_p), equivalent, alarm=alarm) != verdict:
            return False
    return True


def _under_unknown_scale(rivals: RivalSet, key: ModelKey) -> Evidence:
    """Return a rival's record with the evidence that the probabilities rest on."""
    value, error = log_evidence(rivals, key)
    return replace(rivals.fit(key).evidence, log_evidence=value, standard_error=error)

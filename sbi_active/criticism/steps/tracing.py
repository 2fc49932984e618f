"""Attribution to an effect: probabilities over the rivals."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sbi_active.actions import ActionSpace
from sbi_active.criticism.effects.effect import Effect
from sbi_active.criticism.evidence.rival_set import RivalSet
from sbi_active.criticism.forces.library import is_force
from sbi_active.criticism.results import (
    CATCH_ALLS,
    NONE,
    OUTLIER,
    UNEXPLAINED,
    Detection,
    Estimate,
    Evidence,
    ModelKey,
    Tracing,
)
from sbi_active.criticism.steps.detection import THRESHOLD, alternatives
from sbi_active.criticism.steps.equivalence import equivalent_effects
from sbi_active.criticism.steps.influence import is_left_to_chance, withdrawn
from sbi_active.criticism.steps.near_aliases import near_aliases
from sbi_active.criticism.steps.sampled import Sampled
from sbi_active.inference.sampling.weights import log_sum_exp

Array = NDArray[Any]

PROBABILITY_OF_NONE = 0.5  # by convention, neither for nor against
#: Probability that what is missing, if anything is, is each of the catch-alls.
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
        catch_alls: Catch-alls that are compared.
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
    found: Sampled,
    detection: Detection,
    *,
    actions: ActionSpace | None = None,
    compare: bool = True,
    near: bool = True,
) -> Tracing:
    """Return the probabilities of the rivals and the verdict.

    The scales of the effects' priors are unknown. After an alarm the verdict is first
    one of: declared effects, "unexplained", "scatter", each with all of its
    probability; then, of the effects, the most probable of the most probable families.
    Where known noise refutes that (its chi-square has p < .001), the residual process
    is tried beside it: then "unexplained" is the process alone or with these effects,
    half and half. Effects that rest on one trial are named only if that trial has
    hardly a gross error.

    Args:
        found: The models' evidence.
        detection: Whether there is anything to trace.
        actions: The permitted ones, for what they hardly separate.
        compare: Whether to look for effects that are nearly the same.
        near: Whether to look for groups that these trials do not separate as well.
    """
    rivals, equivalent = found.rivals, found.equivalent
    # Without an alarm there is no trial to set aside.
    catch_alls = tuple(n for n in CATCH_ALLS if detection.alarm or n != OUTLIER)
    prior = log_priors(rivals.library, catch_alls)
    keys = [ModelKey.of(name) for name in (NONE, *catch_alls, *rivals.effects)]
    log_prior = {key: prior[str(key)] for key in keys}
    log_z = {key: found.log_evidence(key) for key in keys}
    process = ModelKey(error=UNEXPLAINED)
    if detection.alarm:
        singles = {n: prior[n] + log_z[ModelKey((n,))] for n in rivals.effects}
        for key, value in found.larger(singles, prior).items():
            log_z[key] = found.log_evidence(key)
            log_prior[key] = value - log_z[key]
    log_p = {key: log_prior[key] + log_z[key] for key in log_z}
    p = probabilities_of(log_p)
    verdict = verdict_of(p, found) if detection.alarm else ModelKey()
    beside: tuple[str, ...] = ()
    if verdict.effects and found.is_refuted(verdict, detection):
        # What takes up most of the misfit need not take up all of it.
        names, rest = verdict.effects, found.log_with_process(verdict)
        alone = log_z[process]
        log_z[process] = float(np.logaddexp(alone, rest) - np.log(2))
        log_p[process] = log_prior[process] + log_z[process]
        p = probabilities_of(log_p)
        verdict = verdict_of(p, found)
        if verdict == process and rest > alone:
            beside = names
    evidences = {str(key): found.record(key) for key in log_p}
    groups = equivalent_effects(rivals, None) if compare and near else ()
    aliases = ()
    if compare and detection.alarm:
        singles = {n: log_z[ModelKey((n,))] for n in rivals.effects}
        aliases = near_aliases(rivals, singles, actions, [*equivalent, *groups])
    inclusion = {
        name: sum(share for key, share in p.items() if name in key.effects)
        for name in rivals.effects
    }
    probabilities = {str(key): share for key, share in p.items()}
    null = evidences[NONE].log_evidence
    estimates = likeliest_first(
        estimate_of(
            effect,
            evidences[name],
            probability=inclusion[name],
            log_bayes_factor=log_z[ModelKey((name,))] - null,
        )
        for name, effect in rivals.effects.items()
    )
    tracing = Tracing(
        verdict=str(verdict),
        chosen=verdict.effects,
        probabilities=probabilities,
        inclusion=inclusion,
        credible_set=credible_set(probabilities),
        equivalent=(*equivalent,),
        near=groups,
        aliases=aliases,
        estimates=estimates,
        evidences=evidences,
        robust=_is_robust(found, detection, log_prior, log_z, verdict),
        beside=beside,
        outliers=found.outliers() if detection.alarm else {},
        needed=found.needed(verdict) if verdict.effects else (),
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


def verdict_of(probabilities: Mapping[ModelKey, float], found: Sampled) -> ModelKey:
    """Return the verdict: the kind of explanation, then the most probable of it.

    Several effects that share the probability do not lose it to a catch-all. Equivalent
    ones count as one, and so do forces of one family: it is chosen first, then its
    form.
    """
    catch_alls = {k: p for k, p in probabilities.items() if k.error}
    given = found.rivals, found.equivalent
    classes: dict[frozenset[str], dict[ModelKey, float]] = {}
    for key, p in probabilities.items():
        if key.effects:
            classes.setdefault(kind_of(key, *given), {})[key] = p
    declared = sum(p for members in classes.values() for p in members.values())
    best = max(catch_alls, key=catch_alls.__getitem__, default=ModelKey())
    if catch_alls.get(best, 0.0) > declared or not classes:
        return best
    likeliest = max(classes.values(), key=lambda members: sum(members.values()))
    return max(likeliest, key=likeliest.__getitem__)


def kind_of(
    key: ModelKey, rivals: RivalSet, equivalent: Sequence[frozenset[str]]
) -> frozenset[str]:
    """Return the subject of a set: families of forces, or groups of similar effects.

    Args:
        key: Key of the set.
        rivals: The models.
        equivalent: Groups of effects that no permitted action separates.
    """
    effects = [rivals.effects[name] for name in key.effects]
    groups = [group for group in equivalent if NONE not in group]

    def kind(effect: Effect) -> str:
        if is_force(effect):
            return str(effect.family)
        return min(next((g for g in groups if effect.name in g), {effect.name}))

    return frozenset(map(kind, effects))


def log_bayes_factor(
    log_z: Mapping[ModelKey, float],
    library: Sequence[Effect],
    equivalent: Sequence[frozenset[str]],
) -> float:
    """Return the log Bayes factor of everything else against the bare model.

    Args:
        log_z: Evidences; what was screened out has none to speak of.
        library: All effects.
        equivalent: Groups of them that no permitted action separates.
    """
    names = [e.name for e in library]
    parts = [
        log_z[ModelKey.of(name)] + float(np.log(w))
        for name, w in alternatives(names, equivalent).items()
        if ModelKey.of(name) in log_z
    ]
    return float(log_sum_exp(np.array(parts)) - log_z[ModelKey()])


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
        effect: Effect whose phi is the end of the draws.
        evidence: Evidence of that model.
        probability: Probability that the effect is there.
        log_bayes_factor: Log Bayes factor of that model against the bare one.
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


def _is_robust(
    found: Sampled,
    detection: Detection,
    log_prior: Mapping[ModelKey, float],
    log_z: Mapping[ModelKey, float],
    verdict: ModelKey,
) -> bool:
    """Return whether priors a third and three times as wide give the same verdict."""
    given = rivals, _ = found.rivals, found.equivalent
    for factor in RESCALED:
        scaled = {
            key: found.log_evidence(key, factor=factor) if key.effects else value
            for key, value in log_z.items()
        }
        other = ModelKey()
        if (
            log_bayes_factor(scaled, rivals.library, found.equivalent) > THRESHOLD
            or detection.by_chi_square
        ):
            log_p = {key: log_prior[key] + scaled[key] for key in scaled}
            other = verdict_of(probabilities_of(log_p), found)
        same = kind_of(other, *given) == kind_of(verdict, *given)
        if not same or other.error != verdict.error:
            return False
    return True

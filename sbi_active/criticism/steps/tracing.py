"""Attribution to an effect: probabilities over the rivals."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from math import comb

import numpy as np

from sbi_active.criticism.effects.effect import Effect
from sbi_active.criticism.evidence.rival_set import RivalSet
from sbi_active.criticism.forces.library import is_force
from sbi_active.criticism.results import (
    NONE,
    SCATTER,
    UNEXPLAINED,
    Estimate,
    Evidence,
    ModelKey,
)
from sbi_active.inference.sampling.weights import log_sum_exp

#: All sets of one effect more are together this much less probable, nats.
COST = float(np.log(3.0))
#: Factors on the scale of the effects' priors under which a verdict should stand.
RESCALED = (1 / 3, 3.0)


def log_priors(effects: Sequence[Effect]) -> dict[str, float]:
    """Return log prior probabilities of none and of each effect.

    Half is "none", which is neither for nor against. The families share the rest
    equally.
    """
    members: dict[str, list[str]] = {}
    for effect in effects:
        members.setdefault(str(effect.family), []).append(effect.name)
    found, share = {NONE: 0.5}, 0.5 / max(len(members), 1)
    for names in members.values():
        found |= {name: share / len(names) for name in names}
    return {name: float(np.log(p)) for name, p in found.items()}


def log_prior(names: tuple[str, ...], prior: Mapping[str, float]) -> float:
    r"""Return the log prior probability of a set of k of the n effects.

    It is proportional to the mean of the probabilities :math:`p_i` of its effects
    alone. Over all sets of k these means add up to :math:`\binom{n-1}{k-1} \frac1k
    \sum_i p_i`.
    """
    num, k = len(prior) - 1, len(names)  # all but "none"
    log_mean = log_sum_exp(np.array([prior[name] for name in names])) - np.log(k)
    return float(log_mean + np.log(k / comb(num - 1, k - 1)) - COST * (k - 1))


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

    The residual process, noise inflation and each effect have equal weights; effects
    that nothing separates count as one, and effects that nothing separates from the
    bare model do not count.

    Args:
        log_z: Evidences; what was screened out has none to speak of.
        library: All effects.
        equivalent: Groups of them that no permitted action separates, with "none" for
            the bare model.
    """
    names = [e.name for e in library]
    shares = {UNEXPLAINED: 1.0, SCATTER: 1.0}
    for name in names:
        group = next((g for g in equivalent if name in g), frozenset({name}))
        if NONE not in group:
            shares[name] = 1 / len(group & {*names})
    total = sum(shares.values())
    parts = [
        log_z[ModelKey.of(name)] + float(np.log(share / total))
        for name, share in shares.items()
        if ModelKey.of(name) in log_z
    ]
    return float(log_sum_exp(np.array(parts)) - log_z[ModelKey()])


def credible_set(probabilities: dict[str, float]) -> tuple[str, ...]:
    """Return the smallest set of names with 90 % of the probability, best first."""
    names, total = [], 0.0
    for name, p in probabilities.items():  # most probable first
        names.append(name)
        total += p
        if total >= 0.9:
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

"""Attribution to an effect: probabilities over the rivals."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from math import comb

import numpy as np

from sbi_active.criticism.effects.effect import Effect
from sbi_active.criticism.evidence.rival_set import RivalSet
from sbi_active.criticism.forces.library import is_force
from sbi_active.criticism.results import (
    CATCH_ALLS,
    NONE,
    Estimate,
    Evidence,
    ModelKey,
)
from sbi_active.criticism.steps.detection import alternatives
from sbi_active.inference.sampling.weights import log_sum_exp

#: All sets of one effect more are together this much less probable, nats.
COST = float(np.log(3.0))
#: Factors on the scale of the effects' priors under which a verdict should stand.
RESCALED = (1 / 3, 3.0)


def log_priors(
    effects: Sequence[Effect],
    catch_alls: Sequence[str] = CATCH_ALLS,
    *,
    probability_of_catch_all: float = 0.1,
    probability_of_none: float = 0.5,
) -> dict[str, float]:
    """Return log prior probabilities of none, each effect and the catch-alls.

    Half is "none". Of the rest the catch-alls have a tenth each, and the families
    share what is left equally.

    Args:
        effects: The declared ones.
        catch_alls: Catch-alls that are compared.
        probability_of_catch_all: Probability that what is missing, if anything
            is, is each of the catch-alls.
        probability_of_none: Probability of the bare model: half, by convention,
            is neither for nor against.
    """
    members: dict[str, list[str]] = {}
    for effect in effects:
        members.setdefault(str(effect.family), []).append(effect.name)
    missing = 1 - probability_of_none
    each = missing * probability_of_catch_all
    found = {NONE: probability_of_none} | dict.fromkeys(catch_alls, each)
    share = (missing - len(catch_alls) * each) / max(len(members), 1)
    for names in members.values():
        found |= {name: share / len(names) for name in names}
    return {name: float(np.log(p)) for name, p in found.items()}


def log_prior(names: tuple[str, ...], prior: Mapping[str, float]) -> float:
    r"""Return the log prior probability of a set of k of the n effects.

    It is proportional to the mean of the probabilities :math:`p_i` of its effects
    alone. Over all sets of k these means add up to :math:`\binom{n-1}{k-1} \frac1k
    \sum_i p_i`.
    """
    num, k = sum(name not in (NONE, *CATCH_ALLS) for name in prior), len(names)
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


def credible_set(
    probabilities: dict[str, float],
    *,
    # of the credible set
    mass: float = 0.9,
) -> tuple[str, ...]:
    """Return the smallest set of names with 90 % of the probability, best first."""
    names, total = [], 0.0
    for name, p in probabilities.items():  # most probable first
        names.append(name)
        total += p
        if total >= mass:
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

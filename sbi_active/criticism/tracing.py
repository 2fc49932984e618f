"""Which effect the data point to: probabilities over the rivals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from sbi_active.actions import ActionSpace
from sbi_active.criticism.combinations import grow
from sbi_active.criticism.detection import THRESHOLD
from sbi_active.criticism.effects import Effect
from sbi_active.criticism.equivalence import equivalent_effects
from sbi_active.criticism.errors import log_sum_exp
from sbi_active.criticism.results import (
    NONE,
    SCATTER,
    UNEXPLAINED,
    Detection,
    Estimate,
    Tracing,
)
from sbi_active.criticism.rival_set import RivalSet

__all__ = ["log_priors", "trace"]

Array = NDArray[Any]

PROBABILITY_OF_NONE = 0.5
MASS = 0.9  # of the credible set
#: Factors on the scale of the effects' priors under which a verdict should stand.
RESCALED = (1 / 3, 3.0)


def log_priors(effects: Sequence[Effect]) -> dict[str, float]:
    """Return log prior probabilities of none, each effect and the catch-alls.

    Half is "none"; the families share the rest equally, "unexplained" being one, and
    noise inflation belonging to that of the noise.
    """
    members: dict[str, list[str]] = {UNEXPLAINED: [UNEXPLAINED], "noise": [SCATTER]}
    for effect in effects:
        members.setdefault(str(effect.family), []).append(effect.name)
    share = np.log((1 - PROBABILITY_OF_NONE) / len(members))
    found = {NONE: float(np.log(PROBABILITY_OF_NONE))}
    for names in members.values():
        found |= {name: float(share - np.log(len(names))) for name in names}
    return found


def trace(
    rivals: RivalSet,
    detection: Detection,
    *,
    actions: ActionSpace | None = None,
    compare: bool = True,
) -> Tracing:
    """Return the probabilities of the rivals and the verdict.

    Args:
        rivals: The models.
        detection: Whether there is anything to trace.
        actions: The permitted ones, for what no action separates.
        compare: Whether to look for effects that nothing separates.
    """
    prior = log_priors([*rivals.effects.values()])
    log_p = {
        NONE: prior[NONE] + rivals.evidence().log_evidence,
        UNEXPLAINED: prior[UNEXPLAINED]
        + rivals.evidence(error=UNEXPLAINED).log_evidence,
        SCATTER: prior[SCATTER] + rivals.evidence(error=SCATTER).log_evidence,
    }
    for name in rivals.effects:
        log_p[name] = prior[name] + rivals.evidence((name,)).log_evidence
    if detection.alarm:
        log_p |= grow(rivals, {n: log_p[n] for n in rivals.effects}, prior)
    probabilities = _normalized(log_p)
    equivalent = equivalent_effects(rivals, actions) if compare else ()
    verdict = _verdict(probabilities, equivalent, alarm=detection.alarm)
    chosen = () if verdict in (NONE, UNEXPLAINED, SCATTER) else (*verdict.split(" + "),)
    inclusion = {
        name: sum(p for k, p in probabilities.items() if name in k.split(" + "))
        for name in rivals.effects
    }
    return Tracing(
        verdict=verdict,
        chosen=chosen,
        probabilities=probabilities,
        inclusion=inclusion,
        credible_set=_credible_set(probabilities),
        equivalent=equivalent,
        near=equivalent_effects(rivals, None) if compare else (),
        estimates=_estimates(rivals, inclusion),
        evidences={**rivals.evidences},
        robust=_is_robust(rivals, log_p, equivalent, verdict, prior),
    )


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
    """Return the most probable rival of the most probable class of equivalent ones."""
    if not alarm:
        return NONE
    groups = [group for group in equivalent if NONE not in group]
    classes: dict[frozenset[str], dict[str, float]] = {}
    for name, p in probabilities.items():
        if name == NONE:
            continue
        parts = name.split(" + ")
        key = frozenset(
            min(next((g for g in groups if part in g), {part})) for part in parts
        )
        classes.setdefault(key, {})[name] = p
    best = max(classes.values(), key=lambda members: sum(members.values()))
    return max(best, key=best.__getitem__)


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
                log_bayes_factor=evidence.log_evidence - null,
                mean=phi.mean(0),
                sd=phi.std(0),
                effective_sample_size=evidence.effective_sample_size,
                engine=evidence.engine,
            )
        )
    return (*sorted(found, key=lambda e: -e.probability),)


def _is_robust(
    rivals: RivalSet,
    log_p: dict[str, float],
    equivalent: Sequence[frozenset[str]],
    verdict: str,
    prior: dict[str, float],
) -> bool:
    """Return whether priors a third and three times as wide give the same verdict."""
    for factor in RESCALED:
        scaled = {
            name: value + _log_rescaled(rivals, name, factor)
            for name, value in log_p.items()
        }
        singles = [
            scaled[name] - prior[name]
            for name in [*rivals.effects, UNEXPLAINED, SCATTER]
        ]
        log_b = log_sum_exp(np.array(singles)) - np.log(len(singles))
        alarm = bool(log_b - (log_p[NONE] - prior[NONE]) > THRESHOLD)
        if _verdict(_normalized(scaled), equivalent, alarm=alarm) != verdict:
            return False
    return True


def _log_rescaled(rivals: RivalSet, name: str, factor: float) -> float:
    r"""Return the change of a log evidence when the effects' priors are rescaled.

    .. math::
        \frac{Z'}{Z} = E_{p(\phi | x)}\left[\frac{p(\phi')}{s\, p(\phi)}\right], \qquad
        \phi' = \phi_0 + (\phi - \phi_0) / s .
    """
    effects = [rivals.effects[n] for n in name.split(" + ") if n in rivals.effects]
    evidence = rivals.evidences.get(name)
    if not effects or evidence is None:
        return 0.0
    sizes = [e.phi_dim for e in effects]
    phi = torch.from_numpy(evidence.draws[:, -sum(sizes) :]).split(sizes, -1)
    ratio = torch.zeros(len(evidence.draws), dtype=torch.float64)
    for effect, p in zip(effects, phi, strict=True):
        null = effect.null_phi(len(p))
        if not bool(null.isfinite().all()):
            continue  # a scale about infinity has no meaning
        shrunk = null + (p - null) / factor
        ratio = ratio + effect.log_prob(shrunk) - effect.log_prob(p)
        ratio = ratio - effect.phi_dim * np.log(factor)
    return float(log_sum_exp(ratio.numpy()) - np.log(len(ratio)))

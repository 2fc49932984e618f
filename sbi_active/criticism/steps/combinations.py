"""Sets of several effects, grown from the best."""

from __future__ import annotations

from collections.abc import Mapping
from math import comb
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sbi_active.criticism.evidence.rival_set import RivalSet
from sbi_active.criticism.evidence.unknown_scale import log_evidence
from sbi_active.criticism.results import CATCH_ALLS, NONE, ModelKey
from sbi_active.criticism.steps.detection import THRESHOLD
from sbi_active.inference.sampling.least_squares import basis_of
from sbi_active.inference.sampling.weights import log_sum_exp
from sbi_active.seeding import derive_seed

Array = NDArray[Any]

#: A choice: sets that are kept of each size. The search costs a fit for each of them
#: and each effect that is left.
BEAM = 3
MAX_EFFECTS = 4  # a choice: at most in one model
#: All sets of one effect more are together this much less probable, nats.
COST = float(np.log(3.0))
#: Nats behind the best set that fits, from which a set is not added to.
HOPELESS = 30.0
#: Draws of an effect that are tried on the residual before the effect is fitted.
NUM_TRIED = 8
#: Deviations of the chi-square beyond which a set is far from a fit.
FAR = 10.0
#: Twice the log Bayes factor that a further effect must reach: what it takes off the
#: sum of squares before it pays for a parameter.
WORTH = 2 * THRESHOLD


def grow(
    rivals: RivalSet, singles: dict[str, float], prior: dict[str, float]
) -> dict[ModelKey, float]:
    r"""Return unnormalized log posteriors of sets of effects.

    A beam of width 3 goes from sets of one effect to larger ones. A set counts if it
    has a Bayes factor above 20 against each of its parts that were tried with one
    effect less; all sets of one effect more
    have together a third of the prior probability, so that a longer library does not
    make several effects likelier. An effect is
    fitted beside others only if some draw of it could take as much off their residual.

    Args:
        rivals: The models.
        singles: Log posterior of each effect alone, prior included.
        prior: Log prior probability of each effect alone.
    """
    found: dict[ModelKey, float] = {}
    seen: set[frozenset[str]] = set()
    beam = [(n,) for n in sorted(singles, key=singles.__getitem__)[::-1][:BEAM]]
    for _ in range(MAX_EFFECTS - 1):
        level: dict[tuple[str, ...], float] = {}
        for names in _worthy(rivals, beam):
            for extra in _promising(rivals, names):
                larger = tuple(n for n in rivals.effects if n in (*names, extra))
                if frozenset(larger) in seen:
                    continue
                seen.add(frozenset(larger))
                evidence = log_evidence(rivals, ModelKey(larger))[0]
                if evidence - _best_part(rivals, larger) > THRESHOLD:
                    level[larger] = log_prior(larger, prior) + evidence
        if not level:
            break
        found |= {ModelKey(names): value for names, value in level.items()}
        beam = sorted(level, key=level.__getitem__)[::-1][:BEAM]
    return found


def log_prior(names: tuple[str, ...], prior: Mapping[str, float]) -> float:
    r"""Return the log prior probability of a set of k of the n effects.

    It is proportional to the mean of the probabilities :math:`p_i` of its effects
    alone. Over all sets of k these means add up to :math:`\binom{n-1}{k-1} \frac1k
    \sum_i p_i`.
    """
    num, k = sum(name not in (NONE, *CATCH_ALLS) for name in prior), len(names)
    log_mean = log_sum_exp(np.array([prior[name] for name in names])) - np.log(k)
    return float(log_mean + np.log(k / comb(num - 1, k - 1)) - COST * (k - 1))


def _worthy(rivals: RivalSet, beam: list[tuple[str, ...]]) -> list[tuple[str, ...]]:
    """Return the sets to add to: all, or once one fits, those not far behind it."""
    fits = [names for names in beam if not _is_far(rivals, names)]
    if not fits:
        return beam
    log_z = {n: rivals.fit(ModelKey(n)).evidence.log_evidence for n in beam}
    best = max(log_z[names] for names in fits)
    return [n for n in beam if log_z[n] > best - HOPELESS]


def _is_far(rivals: RivalSet, names: tuple[str, ...]) -> bool:
    """Return whether a set is far from a fit."""
    num, evidence = len(rivals.measurements), rivals.fit(ModelKey(names)).evidence
    return evidence.best_chi_square > num + FAR * np.sqrt(2 * num)


def _best_part(rivals: RivalSet, names: tuple[str, ...]) -> float:
    """Return the largest evidence among a set's parts with one effect less."""
    parts = ModelKey(names).parts
    return max(log_evidence(rivals, p)[0] for p in parts if p in rivals.fits)


def _promising(rivals: RivalSet, names: tuple[str, ...]) -> list[str]:
    """Return effects that could improve on a set by more than they cost.

    Beside the parameters of the set, to first order, the direction d in which a draw of
    the effect moves the predictions takes :math:`(d^T P r)^2 / d^T P d` off the sum of
    squares, with P the projection off the span of their derivatives. Far from a fit
    that says nothing, and every effect is promising.
    """
    if _is_far(rivals, names):
        return [n for n in rivals.effects if n not in names]
    fit = rivals.fit(ModelKey(names))
    rival, at = fit.rival, fit.likeliest
    whiten = rival.error.whitener(rival.residual(at)[0][0])
    r, jacobian = (part[0] for part in rival.jacobian(at, whiten, rivals.step))
    basis = basis_of(jacobian)
    r = r - basis @ (basis.T @ r)
    promising = []
    for extra in rivals.effects:
        if extra in names:
            continue
        if rivals.effects[extra].hook == "noise":
            promising.append(extra)
            continue
        larger = rivals.rival(ModelKey((*names, extra)))
        c = larger.coordinates
        draws = c.sample(NUM_TRIED, seed=derive_seed(rivals.seed, "tried", extra))
        z = rival.coordinates.to_z(at)
        own = sum(rival.coordinates.joint.sizes)
        natural = c.to_z(draws)
        natural[:, :own] = z[:, :own]
        k = rivals.effects[extra].phi_dim
        natural[:, own + k :] = z[:, own:]
        moved = whiten(larger.residual(c.from_z(natural))[0])
        change = moved - whiten(rival.residual(at)[0])
        change = change - (change @ basis) @ basis.T
        length = np.einsum("ni,ni->n", change, change)
        gain = (change @ r) ** 2 / np.maximum(length, 1e-12)
        if gain.max() > WORTH:
            promising.append(extra)
    return promising

"""Levels of an alarm, and probabilities of sets of effects before the data."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import comb
from typing import TypeVar

import numpy as np

from sbi_active.criticism.effects.effect import Effect
from sbi_active.criticism.results import NONE
from sbi_active.inference.sampling.weights import log_sum_exp

#: Log Bayes factor of an alarm: under the bare model's prior predictive it is exceeded,
#: at any stopping time, with a probability of at most 1/20.
THRESHOLD = float(np.log(20.0))
#: Tail probability of the refitted chi-square that is an alarm by itself.
LEVEL = 0.01
#: Tail probability of a chi-square which is too small for the declared noise.
TOO_SMALL = 1e-4
#: Tail probability of a verdict's residual below which something else is missing.
REFUTED = 0.001


Name = TypeVar("Name")

#: All sets of one effect more are together this much less probable, nats.
COST = float(np.log(3.0))


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


def credible_set(probabilities: Mapping[Name, float]) -> tuple[Name, ...]:
    """Return the smallest set of names with 90 % of the probability, best first."""
    names, total = [], 0.0
    for name, p in probabilities.items():  # most probable first
        names.append(name)
        total += p
        if total >= 0.9:
            break
    return (*names,)

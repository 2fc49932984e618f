r"""Guesses of what residuals follow, of numbers without a time axis.

Each guess adds :math:`c\, g(v)` to a model's output, with g one elementary function of
an entry of the action or of the output. Where no declared effect is named, it is
printed if its evidence is above that of a smooth function of the action, or of the
order of the trials (:mod:`..rivals.residual_process`). Where an effect does help,
guesses in its place have evidence, against which that of the effect is held. No trial
is simulated for any of this. Along a trajectory effects and forces leave nothing that
one function of the output follows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sbi_active.arrays import Array
from sbi_active.criticism.linear.mixture import summed
from sbi_active.criticism.linear.model import COORDINATES, LinearModel
from sbi_active.criticism.linear.search import Search
from sbi_active.criticism.results import ModelKey
from sbi_active.inference.sampling.weights import log_sum_exp

#: Nats by which a formula must beat what it stands for to be printed, and a simpler one
#: to be taken in its place.
MARGIN = 2.0
#: Bound on exponents, so that a formula stays finite.
LARGEST_EXPONENT = 20.0
#: The simplest first.
TERMS: dict[str, Callable[[Tensor], Tensor]] = {
    "1": torch.ones_like,
    "{}": lambda v: v,
    "{}^2": lambda v: v**2,
    "{}^3": lambda v: v**3,
    "|{}|": torch.abs,
    "|{}|^1.5": lambda v: v.abs() ** 1.5,
    "step({})": lambda v: (v > 0).to(v.dtype),
    "sign({})": torch.sign,
    "sin({})": torch.sin,
    "cos({})": torch.cos,
    "exp({})": lambda v: v.clamp(max=LARGEST_EXPONENT).exp(),
    "relu({})": torch.relu,
}


def guess_residual(search: Search) -> tuple[tuple[str, float], ...]:
    """Return formulas that the bare model's residual follows, best first.

    The simplest of those that the best does not beat by the margin comes before it.

    Args:
        search: The models, with the bare one.

    Returns:
        Formulas and their log evidence above that of the bare model with its process,
        nats; empty if there is none.
    """
    bare, gains = search.model(ModelKey()), dict[str, float]()
    every = np.ones(search.errors.num_folds, dtype=bool)
    least = summed(*search.smooth(bare, every), bare).log_evidence
    for name, term in _terms(search):
        model = _with_term(bare, term / search.unit)
        gain = float(_log_evidence(search, model, beside=False) - least)
        if gain > MARGIN:
            gains[name] = gain
    best = sorted(gains, key=lambda name: -gains[name])
    alike = [n for n in gains if gains[n] > gains[best[0]] - MARGIN]
    best = [*dict.fromkeys([*alike[:1], *best])]
    return tuple((name, gains[name]) for name in best)


def gained_by_guesses(search: Search, key: ModelKey, name: str) -> float:
    """Return the nats that guesses in the place of an effect gain over it.

    Guesses are equally likely beforehand: their mean evidence counts. Each has one
    coefficient for all numbers of a trial.

    Args:
        search: Search that has fitted the models; x has no time axis.
        key: The set with the effect.
        name: Name of the effect.
    """
    without = search.found[key.without(name)].model
    every = np.ones(len(search.rivals.measurements), dtype=bool)
    found = [
        _log_evidence(search, _with_term(without, term / search.unit))
        for _, term in _distinct(search, every, "", [])
    ]
    mean = log_sum_exp(np.array(found)) - np.log(len(found))
    return float(mean - search.found[key].beside.log_evidence)


def _log_evidence(search: Search, model: LinearModel, *, beside: bool = True) -> float:
    """Return the log evidence of a model that was not simulated, nats."""
    grams = search.errors.grams(model)
    return search.errors.mixture(model, grams, beside=beside).log_evidence


def _with_term(model: LinearModel, term: Array) -> LinearModel:
    """Return a model with one more coefficient, as large as its residual may be."""
    size = float(np.sqrt(np.mean(term**2)))
    column = np.zeros(len(model.residual))
    column[: model.num] = term / model.scale

    new = {"u": 0.0, "center": 0.0, "sd": max(model.rms, 1.0) / size, "scaled": True}
    new |= {"low": -np.inf, "high": np.inf, "trial_of": -1}
    jacobian = np.concatenate([model.jacobian, -column[:, None]], 1)
    every = {name: np.append(getattr(model, name), new[name]) for name in COORDINATES}
    return replace(model, key=ModelKey(("formula",)), jacobian=jacobian, **every)


def _terms(search: Search) -> Iterator[tuple[str, Array]]:
    """Yield formulas with their values, shape (N,), the simpler of two that are one.

    Formulas of all numbers come before those of one channel.
    """
    m = search.rivals.measurements
    several = int(m.channel.max()) > 0
    labels = search.rivals.trials.channel_labels or ()
    seen: list[Array] = []
    if several:
        yield from _distinct(search, np.ones(len(m), dtype=bool), "", seen)
    for channel in range(int(m.channel.max()) + 1):
        own = m.channel == channel
        where = ""
        if several:
            where = labels[channel] if channel < len(labels) else f"channel {channel}"
            where = f" in {where.partition(' [')[0]}"
        yield from _distinct(search, own, where, seen)


def _distinct(
    search: Search, own: NDArray[np.bool_], where: str, seen: list[Array]
) -> Iterator[tuple[str, Array]]:
    """Yield formulas of some numbers that are none of those seen, which they join."""
    for name, value in _variables(search):
        for pattern, g in TERMS.items():
            term = np.where(own, g(torch.from_numpy(value)).numpy(), 0.0)
            size = float(np.linalg.norm(term))
            if not np.isfinite(size) or size < 1e-9 * np.sqrt(len(term)):
                continue
            if any(abs(other @ term) / size > 1 - 1e-9 for other in seen):
                continue
            seen.append(term / size)
            yield pattern.format(name) + where, term


def _variables(search: Search) -> Iterator[tuple[str, Array]]:
    """Yield variables that a residual may follow, shape (N,)."""
    trials, m = search.rivals.trials, search.rivals.measurements
    bare = search.found[ModelKey()].model
    predicted = m.x - bare.residual[: bare.num] * search.unit * bare.scale
    action = trials.action.double().numpy()
    if not trials.action_is_label:
        names = ["xi"]
        if action.shape[1] > 1:
            names = [f"xi_{i + 1}" for i in range(action.shape[1])]
        for j, name in enumerate(names):
            yield name, action[m.trial, j]
    yield "x", predicted

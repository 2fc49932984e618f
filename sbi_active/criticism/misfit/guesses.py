r"""Guesses of what the residual follows where every model misses.

Each guess adds :math:`c\, g(v)` to a model's output, with g one elementary function of
an entry of the action, an input, the output, its slope, or the time in the trial. Where
no declared effect helps along trajectories, it is printed if it removes a quarter of
the excess error on left-out trials, and lowers the error on a new one with a
probability of .9 beside all that were tried; of numbers without a time axis if its
evidence is above that of a smooth function of the action, or of the order of the
trials (:mod:`..rivals.residual_process`). Where an effect does help, guesses in its
place have evidence, against which that of the effect is held. No trial is simulated for
any of this.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sbi_active.arrays import Array
from sbi_active.criticism.linear.left_out import leave_out
from sbi_active.criticism.linear.mixture import summed
from sbi_active.criticism.linear.model import COORDINATES, LinearModel
from sbi_active.criticism.linear.search import Search
from sbi_active.criticism.misfit.scored import predicts_better
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
#: Share of the excess error on left-out parts that a guess may leave.
REMAINS = 0.75


def guess_residual(search: Search) -> tuple[tuple[str, float], ...]:
    """Return formulas that the bare model's residual follows, best first.

    Of numbers without a time axis, the simplest of those that the best does not beat by
    the margin comes before it.

    Args:
        search: The models, with the bare one.

    Returns:
        Formulas and their log evidence above that of the bare model with its process,
        nats; empty if there is none.
    """
    timed, bare = search.rivals.measurements.is_sequence, search.found[ModelKey()]
    least = bare.beside.log_evidence
    if not timed:
        every = np.ones(search.errors.num_folds, dtype=bool)
        least = summed(*search.smooth(bare.model, every), bare.model).log_evidence
    terms, gains = [*_terms(search, of_all=not timed)], {}
    for name, term in terms:
        model = _with_term(bare.model, term / search.unit)
        if timed and not _predicts(search, model, len(terms)):
            continue
        gain = float(_log_evidence(search, model, beside=timed) - least)
        if gain > MARGIN:
            gains[name] = gain
    best = sorted(gains, key=lambda name: -gains[name])
    if not timed:
        alike = [n for n in gains if gains[n] > gains[best[0]] - MARGIN]
        best = [*dict.fromkeys([*alike[:1], *best])]
    return tuple((name, gains[name]) for name in best)


def _predicts(search: Search, model: LinearModel, tried: int) -> bool:
    """Return whether a guess predicts left-out trials, beside all that were tried."""
    bare, left = search.found[ModelKey()].left, leave_out(model, search.errors)
    sure = 1 - (1 - 0.9) / tried
    excess = max(bare.mean_square - 1, 1e-2)
    enough = predicts_better(left.square, bare.square) >= sure
    return enough and (left.mean_square - 1) / excess <= REMAINS


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
    grams = search.errors.grams(model.rows)
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


def _terms(search: Search, *, of_all: bool = False) -> Iterator[tuple[str, Array]]:
    """Yield formulas with their values, shape (N,), the simpler of two that are one.

    Args:
        search: Search that has fitted the bare model.
        of_all: Whether formulas of all numbers come before those of one channel.
    """
    m = search.rivals.measurements
    several = int(m.channel.max()) > 0
    labels = search.rivals.trials.channel_labels or ()
    seen: list[Array] = []
    if of_all and several:
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
    for name, value in _variables(search, own):
        for pattern, g in TERMS.items():
            term = np.where(own, g(torch.from_numpy(value)).numpy(), 0.0)
            size = float(np.linalg.norm(term))
            if not np.isfinite(size) or size < 1e-9 * np.sqrt(len(term)):
                continue
            if any(abs(other @ term) / size > 1 - 1e-9 for other in seen):
                continue
            seen.append(term / size)
            yield pattern.format(name) + where, term


def _variables(search: Search, own: NDArray[np.bool_]) -> Iterator[tuple[str, Array]]:
    """Yield variables that a residual of some numbers may follow, shape (N,)."""
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
    if not m.is_sequence:
        return
    slope, since = np.zeros(len(m)), np.zeros(len(m))
    for trial in np.unique(m.trial):
        at = np.flatnonzero((m.trial == trial) & own)
        if len(at) > 1:
            slope[at] = np.gradient(predicted[at], m.time[at])
            since[at] = m.time[at] - m.time[at].min()
    yield "x'", slope
    yield "t", since
    if trials.inputs is None or trials.input_times is None:
        return
    grid = trials.input_times.double().numpy()
    place = np.searchsorted(grid, m.time + 1e-9 * np.ptp(grid), side="right") - 1
    for name, series in trials.inputs.items():
        values = series.double().numpy()
        yield name, values[m.trial, np.clip(place, 0, len(grid) - 1)]

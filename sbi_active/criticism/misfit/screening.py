"""Which effects of a large library are worth a fit: linear evidence of one Jacobian.

A fit of an effect takes some hundred simulations of the trials, its column one. With
the bare model's best fit and a column of every effect the evidence of all singles and
pairs is linear algebra; effects that are in none of the best are set aside.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sbi_active.criticism.evidence.rival_set import RivalSet
from sbi_active.criticism.misfit.linear import LinearModel
from sbi_active.criticism.misfit.processes import Grams, Posterior
from sbi_active.criticism.misfit.search import Search
from sbi_active.criticism.misfit.sensor import sensor_error
from sbi_active.criticism.results import ModelKey
from sbi_active.criticism.steps.combinations import log_prior
from sbi_active.criticism.steps.tracing import log_priors

Array = NDArray[Any]

#: Effects of which all are fitted.
MANY = 24
#: Effects that are kept: the best alone, members of the best pairs, and those whose
#: linear optimum leaves the smallest residual of the simulator itself.
BEST, NUM_PAIRS, CLOSEST = 8, 6, 4
#: Effects whose linear optimum is simulated, and whose pairs are compared.
TRIED, PAIRED = 20, 60


@dataclass(frozen=True)
class Screening:
    """What linear evidence says of a library.

    Attributes:
        kept: Names of the effects that are worth a fit, in the library's order.
        behind: Nats by which each effect that was set aside is behind the best set,
            alone or in a pair that is better than either member, nearest first.
    """

    kept: tuple[str, ...]
    behind: dict[str, float]


def screen(rivals: RivalSet) -> Screening | None:
    """Return which effects are worth a fit; None where all are to be fitted.

    So it is with at most 24, and where the size of the sensor's error is not declared,
    x has no time axis, or the simulator is random or jumps.

    Args:
        rivals: The models, with all effects.
    """
    sensor = sensor_error(rivals)
    if len(rivals.effects) <= MANY or sensor is None:
        return None
    unit, cells = sensor
    search = Search(rivals, unit, log_priors(rivals.library, ()), cells)
    linear = _Library(search)
    singles = {n: linear.score((n,)) for n in linear.names}
    ranked = sorted(singles, key=singles.__getitem__)[::-1]
    best = dict(singles)
    pairs: dict[tuple[str, ...], float] = {}
    paired = [n for n in linear.names if n in ranked[:PAIRED]]
    linear.prepare(paired)
    for pair in combinations(paired, 2):
        value = linear.score(pair)
        if value > max(singles[name] for name in pair):
            pairs[pair] = value
            for name in pair:
                best[name] = max(best[name], value)
    kept = {*ranked[:BEST]}
    for pair in sorted(pairs, key=pairs.__getitem__)[::-1][:NUM_PAIRS]:
        kept.update(pair)
    left = {n: linear.remains(n) for n in ranked[:TRIED]}
    kept.update(sorted(left, key=left.__getitem__)[:CLOSEST])
    # Effects on the noise change no prediction, and no column tells of them.
    kept.update(n for n in rivals.effects if n not in singles)
    top = max(best.values())
    behind = {n: top - v for n, v in best.items() if n not in kept}
    if not behind:
        return None
    return Screening(
        tuple(n for n in rivals.effects if n in kept),
        dict(sorted(behind.items(), key=lambda item: item[1])),
    )


def worth_fitting(rivals: RivalSet) -> tuple[RivalSet, Screening | None]:
    """Return the models of the effects that are worth a fit, and what was set aside.

    Prior probabilities stay those of the whole library: what was looked at and set
    aside counts.

    Args:
        rivals: The models, with all effects.
    """
    found = screen(rivals)
    if found is None:
        return rivals, None
    kept = [*[rivals.effects[n] for n in found.kept], *rivals.nuisances]
    own = RivalSet(
        rivals.model,
        rivals.prior,
        rivals.trials,
        kept,
        actions=rivals.actions,
        seed=rivals.seed,
    )
    own.library = rivals.library
    return own, found


class _Library:
    """A bare model at its best fit, with a column of every effect.

    Coordinates of effects count from where their columns were taken.
    """

    def __init__(self, search: Search) -> None:
        self.search, self.names = search, search.names
        self.bare = search.found[ModelKey()].model
        self._singles: dict[str, LinearModel] = {}
        self._blocks: dict[str, NDArray[np.bool_]] = {}
        for name in self.names:
            self._singles[name], self._blocks[name] = search.beside(ModelKey(), name)
        self._grams: Grams | None = None
        self._places: dict[str, NDArray[np.intp]] = {}
        self._found: dict[tuple[str, ...], Posterior] = {}

    def prepare(self, names: Sequence[str]) -> None:
        """Compute once what all pairs of some effects take."""
        dim = 1 + len(self.bare.u)
        for name in names:
            width = int(self._blocks[name].sum())
            self._places[name] = np.arange(dim, dim + width)
            dim += width
        self._grams = self.search.errors.grams(self._model(names).rows)

    def score(self, names: tuple[str, ...]) -> float:
        """Return the log posterior probability of a set, unnormalized."""
        posterior = self._posterior(names)
        return posterior.log_evidence + log_prior(names, self.search.prior)

    def remains(self, name: str) -> float:
        """Return the rms of the simulator's residual at an effect's linear optimum."""
        model, own = self._singles[name], self._blocks[name]
        mean = self._posterior((name,)).mean
        u = np.empty(len(model.u))
        u[~own], u[own] = mean[: (~own).sum()], mean[(~own).sum() :] + model.u[own]
        return self.search.rms(model.key, np.clip(u, model.low, model.high))

    def _posterior(self, names: tuple[str, ...]) -> Posterior:
        if names not in self._found:
            model, errors = self._model(names), self.search.errors
            self._found[names] = errors.posterior(model, self._grams_of(names, model))
        return self._found[names]

    def _grams_of(self, names: tuple[str, ...], model: LinearModel) -> Grams:
        if self._grams is None or any(n not in self._places for n in names):
            return self.search.errors.grams(model.rows)
        at = np.arange(1 + len(self.bare.u))
        at = np.concatenate([at, *[self._places[n] for n in names]])
        gram = self._grams.gram[..., at[:, None], at]
        return Grams(gram, self._grams.log_det, self._grams.count)

    def _model(self, names: Sequence[str]) -> LinearModel:
        """Return the bare model with the columns of some effects after its own."""
        bare = self.bare
        parts = [(self._singles[n], self._blocks[n]) for n in names]

        def joined(field: str) -> Array:
            own = [getattr(model, field)[block] for model, block in parts]
            return np.concatenate([getattr(bare, field), *own])

        def shifted(field: str) -> Array:
            own = [(getattr(m, field) - m.u)[block] for m, block in parts]
            return np.concatenate([getattr(bare, field), *own])

        columns = [model.jacobian[:, block] for model, block in parts]
        return LinearModel(
            key=ModelKey(tuple(names)),
            u=np.concatenate([bare.u, *[np.zeros(block.sum()) for _, block in parts]]),
            residual=bare.residual,
            jacobian=np.concatenate([bare.jacobian, *columns], 1),
            center=shifted("center"),
            sd=joined("sd"),
            scaled=joined("scaled"),
            low=shifted("low"),
            high=shifted("high"),
            own=bare.own,
            trial_of=joined("trial_of"),
        )

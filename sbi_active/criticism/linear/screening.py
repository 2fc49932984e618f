"""Screening of a large library of effects by the linear evidence of one Jacobian.

A fit of an effect takes a dozen simulations of the trials, its column one. With the
bare model's best fit and a column of every effect the evidence of all singles and pairs
is linear algebra; effects that are in none of the best are set aside.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from sbi_active.arrays import Array
from sbi_active.criticism.data.measurements import Measurements
from sbi_active.criticism.evidence.rival_set import RivalSet
from sbi_active.criticism.forces.library import is_force
from sbi_active.criticism.linear.fits import JUMPING, FitSettings, best_fit, sensor_of
from sbi_active.criticism.linear.model import LinearModel
from sbi_active.criticism.linear.search import Search
from sbi_active.criticism.results import ModelKey
from sbi_active.criticism.steps.equivalence import MANY

#: Effects that are kept: the best alone, members of the best pairs, and those whose
#: linear optimum leaves the smallest residual of the simulator itself.
BEST, NUM_PAIRS, CLOSEST = 8, 6, 4
#: Effects whose linear optimum is simulated, and whose pairs are compared.
TRIED, PAIRED = 20, 30


@dataclass(frozen=True)
class Screening:
    """The result of screening a library by linear evidence.

    Attributes:
        kept: Names of the effects that are worth a fit, in the library's order.
        behind: Nats by which each effect that was set aside is behind the best set,
            alone or in a pair that is better than either member, nearest first.
    """

    kept: tuple[str, ...]
    behind: dict[str, float]


def linear_models(rivals: RivalSet) -> tuple[Search, Screening | None]:
    """Return linear models of the trials, and which effects were set aside.

    Prior probabilities stay those of the whole library: what was looked at and set
    aside counts.

    Args:
        rivals: The models, with all effects.

    Returns:
        The models, without what is set aside; None for a screening where all effects
        are to be fitted.
    """
    settings = JUMPING if rivals.roughness.any() else FitSettings()
    if rivals.noise.is_by_channel:
        own = rivals.rival(ModelKey()), rivals.prior_draws, rivals.noise.typical_sd
        rivals = _sized(rivals, own[2], [best_fit(*own, settings)])
    search = Search(rivals, sensor_of(rivals), settings)
    if rivals.noise.is_by_channel:
        # What is missing may be seen in one channel alone, and no error of it.
        search.fit_singles()
        models, m = [c.model for c in search.found.values()], rivals.measurements
        best = min(models, key=lambda model: _log_sizes(model.residual, m))
        rivals = _sized(rivals, search.unit, [search.model(ModelKey()), best])
        search = Search(rivals, sensor_of(rivals), settings)
    if len(rivals.effects) <= MANY:
        return search, None
    search.library.look_at_each()
    found = _best_of(search, rivals.effects)
    if found is None:
        return search, None
    found = _with_kin(found, search)
    search.rivals = rivals.with_effects(found.kept)
    return search, found if found.behind else None


def _sized(rivals: RivalSet, unit: Array, fits: Sequence[LinearModel]) -> RivalSet:
    """Return the models with errors of the sizes that fits leave, by channel."""
    m = rivals.measurements
    left = [np.sqrt(m.by_channel((fit.residual * unit) ** 2)) for fit in fits]
    return rivals.with_sizes(left)


def _log_sizes(residual: Array, m: Measurements) -> float:
    """Return the log size of residuals, summed over numbers, by channel."""
    rms = np.sqrt(m.by_channel(residual**2))
    return float(np.bincount(m.channel) @ np.log(np.maximum(rms, 1e-300)))


def _with_kin(found: Screening, search: Search) -> Screening:
    """Return what is fitted, with all forms of a family where none explains.

    Far from a fit a Jacobian tells the family sooner than the form.
    """
    search.restrict(found.kept)
    search.fit_singles()
    effects = search.rivals.effects
    keys = [k for k in search.found if k.effects]
    if search.explains or not keys:
        return found
    closest = min(keys, key=lambda k: search.found[k].model.cost)
    family = effects[closest.effects[0]].family
    if not is_force(effects[closest.effects[0]]):
        return found
    kin = {n for n, e in effects.items() if e.family == family} - {*found.kept}
    kept = tuple(n for n in effects if n in {*found.kept, *kin})
    search.restrict(kept)
    search.fit_singles()
    return Screening(kept, {n: v for n, v in found.behind.items() if n not in kin})


def _best_of(search: Search, every: Collection[str]) -> Screening | None:
    """Return the effects of a library that are worth a fit; None for all."""
    linear = search.library
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
    left = {n: search.rms(*linear.optimum(n)) for n in ranked[:TRIED]}
    kept.update(sorted(left, key=left.__getitem__)[:CLOSEST])
    # Effects on the noise change no prediction, and no column tells of them.
    kept.update(n for n in every if n not in singles)
    top = max(best.values())
    behind = {n: top - v for n, v in best.items() if n not in kept}
    if not behind:
        return None
    return Screening(
        tuple(n for n in every if n in kept),
        dict(sorted(behind.items(), key=lambda item: item[1])),
    )

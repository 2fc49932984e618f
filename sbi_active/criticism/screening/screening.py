"""Which effects of a large library are worth a fit: linear evidence of one Jacobian.

A fit of an effect takes some hundred simulations of the trials, its column one. With
the bare model's best fit and a column of every effect the evidence of all singles and
pairs is linear algebra; effects that are in none of the best are set aside.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

from sbi_active.criticism.evidence.rival_set import RivalSet
from sbi_active.criticism.forces.library import is_force
from sbi_active.criticism.misfit.search import Search
from sbi_active.criticism.misfit.sensor import sensor_error
from sbi_active.criticism.screening.few_simulations import FewSimulations
from sbi_active.criticism.screening.library import Library
from sbi_active.criticism.steps.tracing import log_priors

#: Effects of which all are fitted.
MANY = 24
#: Effects that are kept: the best alone, members of the best pairs, and those whose
#: linear optimum leaves the smallest residual of the simulator itself.
BEST, NUM_PAIRS, CLOSEST = 8, 6, 4
#: Effects whose linear optimum is simulated, and whose pairs are compared.
TRIED, PAIRED = 20, 60
#: The latter, where fits take few simulations and time counts.
FEW_PAIRED = 30


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
    return _best_of(Library(search))


def worth_fitting(
    rivals: RivalSet,
) -> tuple[RivalSet, Screening | None, FewSimulations | None]:
    """Return the models of the effects that are worth a fit, and what was set aside.

    Prior probabilities stay those of the whole library: what was looked at and set
    aside counts. With forces of the dictionary, or with more than 24 effects, fits come
    with it, since these are too many for others.

    Args:
        rivals: The models, with all effects.
    """
    sensor = sensor_error(rivals)
    if sensor is not None and _fits_with_few(rivals):
        unit, cells = sensor
        few = FewSimulations(rivals, unit, log_priors(rivals.library, ()), cells)
        found = None
        if len(rivals.effects) > MANY:
            few.library.look_at_each()
            found = _best_of(few.library, FEW_PAIRED)
        if found is not None:
            found = _with_kin(found, few)
            rivals.effects = {n: rivals.effects[n] for n in found.kept}
        return rivals, found if found and found.behind else None, few
    found = screen(rivals)
    if found is None:
        return rivals, None, None
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
    return own, found, None


def _fits_with_few(rivals: RivalSet) -> bool:
    """Return whether models are fitted from their linearizations.

    No column tells of effects on the noise, and unknowns of each trial need a search.
    """
    if any(map(is_force, rivals.library)):
        return True
    columns = all(e.hook != "noise" for e in rivals.library)
    return len(rivals.effects) > MANY and columns and not rivals.nuisances


def _with_kin(found: Screening, few: FewSimulations) -> Screening:
    """Return what is fitted, with all forms of a family where none explains.

    Far from a fit a Jacobian tells the family sooner than the form.
    """
    every = few.names
    few.restrict(found.kept)
    few.fit_singles()
    kin = few.kin(every)
    if not kin:
        return found
    kept = tuple(n for n in few.rivals.effects if n in {*found.kept, *kin})
    few.restrict(kept, every)
    few.fit_singles()
    return Screening(kept, {n: v for n, v in found.behind.items() if n not in kin})


def _best_of(linear: Library, num_paired: int = PAIRED) -> Screening | None:
    """Return which effects of a library are worth a fit; None for all."""
    rivals = linear.search.rivals
    singles = {n: linear.score((n,)) for n in linear.names}
    ranked = sorted(singles, key=singles.__getitem__)[::-1]
    best = dict(singles)
    pairs: dict[tuple[str, ...], float] = {}
    paired = [n for n in linear.names if n in ranked[:num_paired]]
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

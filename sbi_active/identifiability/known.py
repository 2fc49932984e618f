"""Combinations of parameters that a belief knows, and those that it does not."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from textwrap import shorten
from typing import Any, ClassVar

import numpy as np
from scipy.stats import entropy
from torch.distributions import Distribution

from sbi_active.arrays import Array
from sbi_active.identifiability.formula import Combination, Term, linked
from sbi_active.identifiability.search import FormulaSettings, search, width
from sbi_active.seeding import draws_of


@dataclass(frozen=True, kw_only=True)
class CombinationSettings:
    """Settings of what is said of parameters together.

    Attributes:
        num_draws: Number of draws; an interval's ends are known to a twentieth
            of its length.
        open: Prior deviations above which a parameter is not known by itself:
            what a product that is known exactly leaves of one of its factors
            may be no more, by the other's bounds.
        wide: Prior deviations above which a parameter that is in no combination
            is said not to be known: a uniform belief over half of a uniform
            prior has as much.
        bins: Number of equally probable bins of the prior.
        filled: Share of the bins that the belief fills, in prior deviations and
            at most 1 of them, below which it is several narrow modes: one
            Gaussian hump fills 1.2.
        enough: Number of effective draws a parameter below which their
            covariance has narrow directions that the belief has not.
        named: Number of characters of the names of parameters.
        outliers: Share of draws left out: a belief may hold a little of the
            prior.
        formulas: Settings of the search for formulas.
    """

    num_draws: int = 2_000
    open: float = 0.3
    wide: float = 0.5
    bins: int = 20
    filled: float = 0.5
    enough: int = 10
    named: int = 60
    outliers: float = 0.01
    formulas: FormulaSettings = field(default_factory=FormulaSettings)


@dataclass(frozen=True)
class KnownCombination:
    """A combination that the belief knows while its parameters are open.

    Attributes:
        text: The formula.
        value: Median of the combination.
        low: End of its central 90 % interval.
        high: Other end of that interval.
        width: Standard deviation of the sum, or of a product's logarithm, in those of
            the prior.
        level: Level of the interval.
    """

    level: ClassVar[float] = 0.9
    text: str
    value: float
    low: float
    high: float
    width: float

    def __str__(self) -> str:
        largest = max(abs(self.low), abs(self.high), 1e-300)
        share = max((self.high - self.low) / largest, 2e-5)
        digits = max(math.ceil(math.log10(20 / share)), 2)  # that say something
        value, low, high = (
            f"{v:.{digits}g}" for v in (self.value, self.low, self.high)
        )
        return f"{self.text} = {value} [{low}, {high}] ({self.level:.0%})"


@dataclass(frozen=True)
class UnknownCombination:
    """A combination, or parameters by themselves, that the belief does not know.

    Attributes:
        text: The formula, or names.
        width: Width as in :class:`KnownCombination`; the smallest of several
            parameters.
    """

    text: str
    width: float

    def __str__(self) -> str:
        if self.width > 0.9:
            return f"{self.text} (as wide as the prior)"
        return f"{self.text} ({self.width:.0%} as wide as the prior)"


@dataclass(frozen=True)
class Combinations:
    """Knowledge of parameters that a belief does not know one by one.

    False if there is nothing to say: every parameter is known by itself, or nothing
    is known much better than anything else.

    Attributes:
        known: Combinations with their intervals.
        unknown: Combinations that are left open.
    """

    known: tuple[KnownCombination, ...] = ()
    unknown: tuple[UnknownCombination, ...] = ()

    def __bool__(self) -> bool:
        return bool(self.known or self.unknown)

    def __str__(self) -> str:
        known = [*map(str, self.known[:3])]  # more are no sentence
        known += ["..."] * (len(self.known) > len(known))
        parts = [f"known: {', '.join(known)}"] if known else []
        if self.unknown:
            parts.append(f"not known: {', '.join(map(str, self.unknown))}")
        return "; ".join(parts)

    def to_dict(self) -> dict[str, Any]:
        """Return the combinations in a form that JSON can hold."""
        parts = {"known": self.known, "unknown": self.unknown}
        return {k: [dict(vars(c)) for c in own] for k, own in parts.items() if own}


def combinations_of(
    belief: Distribution,
    prior: Distribution,
    names: Sequence[str] | None = None,
    *,
    seed: int = 0,
    settings: CombinationSettings = CombinationSettings(),  # noqa: B008  (frozen)
) -> Combinations:
    r"""Return the combinations of parameters that a belief knows, and does not know.

    They are found from 2,000 draws of each. A parameter is open if its standard
    deviation is above 0.3 of the prior's; a combination of open parameters is known if
    it has, in prior deviations of its own, at most a tenth of the width of any of them.
    The formulas are sums, products and ratios with weights, products with an
    exponential, and products of the kind a (b + c), see :func:`.search`. A parameter
    that is in none of them is not known where it has more than half of the prior's
    deviation while something else has a tenth of that. It is the belief that speaks: a
    further trial may determine what this says is open; :func:`.check_simulator` tells
    whether any action could.

    Args:
        belief: Belief after some trials.
        prior: Prior before any trial.
        names: Names of the parameters; None is theta_1, theta_2, ...
        seed: Seed of the draws.
        settings: Settings of what counts as open, and as known.

    References:
        Gutenkunst et al., Universally sloppy parameter sensitivities in systems biology
        models, PLoS Comput. Biol. 2007; Raue et al., Structural and practical
        identifiability analysis of partially observed dynamical models by exploiting
        the profile likelihood, Bioinformatics 2009.
    """
    draws = []
    for key, distribution in (("belief", belief), ("prior", prior)):
        drawn = draws_of(distribution, settings.num_draws, seed, "combinations", key)
        draws.append(drawn.double().numpy())
    return combinations_of_draws(draws[0], draws[1], names, settings)


def combinations_of_draws(
    after: Array,
    before: Array,
    names: Sequence[str] | None = None,
    settings: CombinationSettings = CombinationSettings(),  # noqa: B008  (frozen)
) -> Combinations:
    """Return combinations by draws of a belief and of the prior, (m, d) and (n, d)."""
    dim = before.shape[1]
    is_finite = np.isfinite(before).all() and np.isfinite(after).all()
    if dim < 2 or not is_finite or _effective(after) < settings.enough * dim:
        return Combinations()
    names = names or [f"theta_{i + 1}" for i in range(dim)]
    kept = _without_outliers(after, settings.outliers)

    def moments(terms: Sequence[Term]) -> tuple[Array, Array]:
        each = (
            np.stack([t.coordinate(rows) for t in terms]) for rows in (kept, before)
        )
        own, old = (np.cov(part).reshape(2 * [len(terms)]) for part in each)
        return own, old

    everything = np.concatenate([before, after])
    low, span = everything.min(0), np.ptp(before, 0)
    own = kept.std(0) / np.maximum(before.std(0), 1e-300)
    filled = _filled(after, before, settings.bins)
    is_open = (own > settings.open) & (filled > settings.filled * own.clip(max=1.0))
    formulas = settings.formulas
    indices = np.flatnonzero(is_open).tolist()
    widths = dict(search(moments, indices, low, span, formulas))
    groups = linked([*widths])
    tail = 0.5 * (1 - KnownCombination.level)
    known = []
    for combination in (c for group in groups for c in group):
        value = combination.value(after)
        low, middle, high = np.quantile(value, [tail, 0.5, 1 - tail]).tolist()
        found = combination.text(names), middle, low, high, widths[combination]
        known.append(KnownCombination(*found))
    unknown = [_left(group, moments, own, names, settings) for group in groups]
    named = {i for c in widths for i in c.index}
    best = min([*own[~is_open].tolist(), *widths.values()], default=np.inf)
    for i in np.flatnonzero(is_open & (own > settings.wide)).tolist():
        if i not in named and best < formulas.known * own[i]:
            unknown.append(UnknownCombination(names[i], float(own[i])))
    return Combinations(tuple(known), tuple(unknown))


def note_combinations(belief: Any, names: Sequence[str] | None, *, seed: int) -> None:
    """Write what a belief knows together into its diagnostics.

    Args:
        belief: A :class:`.Belief`.
        names: Names of the parameters, or None.
        seed: Seed of the draws.
    """
    with suppress(np.linalg.LinAlgError):  # of draws without a covariance
        found = combinations_of(belief, belief.prior, names, seed=seed)
        belief.diagnostics = belief.diagnostics.extended(combinations=found)


def _effective(draws: Array) -> float:
    """Return the number of different draws, repetitions weighed."""
    count = np.unique(draws, axis=0, return_counts=True)[1]
    return float(count.sum() ** 2 / (count**2).sum())


def _without_outliers(draws: Array, share: float) -> Array:
    """Return the draws nearest to their mean, by their covariance."""
    step = draws - draws.mean(0)
    inverse = np.linalg.pinv(np.cov(step.T), hermitian=True)
    distance = np.einsum("ni,ij,nj->n", step, inverse, step)
    return draws[distance <= np.quantile(distance, 1 - share)]


def _filled(draws: Array, prior: Array, bins: int) -> Array:
    """Return the share of the prior's bins that each parameter fills, shape (d,)."""
    edges = np.quantile(prior, np.linspace(0, 1, bins + 1)[1:-1], axis=0)
    each = zip(draws.T, edges.T, strict=True)
    places = [np.bincount(np.searchsorted(at, own), minlength=bins) for own, at in each]
    return np.exp(entropy(places, axis=1)) / bins


def _left(
    group: Sequence[Combination],
    moments: Any,
    own: Array,
    names: Sequence[str],
    settings: CombinationSettings,
) -> UnknownCombination:
    """Return the combination that the known ones leave open."""
    if len(group) == 1 and len(group[0].terms) == 2:
        first, second = group[0].terms
        other = Combination((first, replace(second, weight=-second.weight)))
        wide = width(other.weight, *moments(other.terms))
        if wide > settings.open:
            return UnknownCombination(other.text(names), wide)
    index = sorted({i for c in group for i in c.index})
    each = shorten(
        ", ".join(names[i] for i in index), settings.named, placeholder=" ..."
    )
    least = float(own[index].min())
    return UnknownCombination(f"{each}, each by itself", least)

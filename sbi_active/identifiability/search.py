"""The search for combinations that are known while their parameters are not."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag

from sbi_active.arrays import Array
from sbi_active.identifiability.formula import SIMPLE, Combination, Term

#: Returns the covariance of the terms, not weighed, and that under the prior: (m, m).
Moments = Callable[[Sequence[Term]], tuple[Array, Array]]


@dataclass(frozen=True, kw_only=True)
class FormulaSettings:
    """Settings of the search for formulas.

    Attributes:
        known: Width of a combination that is known, in prior deviations, over that of
            each of its parameters: a tenth, so that three decimals of sampling error
            or a strong correlation (.99) are not taken for it.
        as_good: Factor by which a formula may be wider than the best one and be
            preferred as simpler.
        about_as_good: Factor of the smallest width within which formulas of different
            kinds are as good.
        worth_a_shift: Width of the best pair from which a shift, as in a * (b + 0.5),
            is looked for.
        shifts: Shifts that are tried, in ranges of the parameter.
        most_shifted: Number of pairs of which a shift is looked for at most, the
            narrowest first: all of twelve parameters. Each takes some 50 ms, where it
            may be known.
        most_triples: Number of parameters up to which all triples are tried.
        dependent: Share of a combination's deviation that others leave of it under the
            prior, below which it is none.
        together: Width, in prior deviations, that a combination of known ones may have:
            rounded weights leave each of them slightly off what is known, and the
            differences of many would add up to a direction of which nothing is.
        floor: Width below which combinations are as good as each other.
    """

    known: float = 0.1
    as_good: float = 1.1
    about_as_good: float = 1.3
    worth_a_shift: float = 0.5
    shifts: tuple[float, ...] = (0.03, 0.06, 0.12, 0.25, 0.5, 1.0, 2.0, 4.0)
    most_shifted: int = 66
    most_triples: int = 20
    dependent: float = 0.1
    together: float = 0.5
    floor: float = 0.0


def search(
    moments: Moments,
    open_parameters: Sequence[int],
    low: Array,
    span: Array,
    limits: FormulaSettings = FormulaSettings(),  # noqa: B008  (frozen)
) -> list[tuple[Combination, float]]:
    r"""Return combinations that are known though their parameters are not.

    Combinations are sums :math:`g = \sum_i w_i t_i(\theta_i)`, t the identity or a
    logarithm. The one with the smallest :math:`\sqrt{w^T C w / w^T S w}`, C the
    covariance and S that of the prior, is the last eigenvector of a generalized
    eigenproblem. Pairs come first, then triples, then all parameters at once, each
    independent of those before. The simplest of the formulas that are about as narrow
    as the best is taken.

    Args:
        moments: Function that returns the covariance C and the prior's S of any terms.
        open_parameters: Indices of those that are not known by themselves.
        low: Smallest value of each parameter under the prior, shape (d,).
        span: Range of each under the prior, shape (d,).
        limits: Settings of what counts as known, and as simpler.

    Returns:
        Each with its width; empty if there are none.
    """
    found: list[tuple[Combination, float]] = []
    if len(open_parameters) < 2:
        return found
    plain = [Term(i) for i in open_parameters]
    covariance, prior = (m.diagonal() for m in moments(plain))
    alone = dict(zip(open_parameters, np.sqrt(covariance / prior), strict=True))

    def keep(combination: Combination, own: float) -> None:
        if own > limits.known * min(alone[i] for i in combination.index):
            return
        together = [*(c for c, _ in found), combination]
        weight = block_diag(*(c.weight for c in together))
        parts = moments([t for c in together for t in c.terms])
        c, s = (weight @ m @ weight.T for m in parts)
        unit = np.sqrt(s.diagonal())
        apart = np.linalg.inv(s / np.outer(unit, unit) + 1e-9 * np.eye(len(s)))
        is_new = apart[-1, -1] * limits.dependent**2 < 1
        if is_new and _eigenvectors(c, s)[0][-1] <= limits.together:
            found.append((combination, own))

    sizes = (2, 3) if len(plain) <= limits.most_triples else (2,)
    for size in sizes:
        ranked = _ranked(moments, open_parameters, size, low)
        for rank, (best, subset) in enumerate(ranked):
            if len(found) >= len(plain) - 1:
                return found
            may_shift = size == 2 and rank < limits.most_shifted
            if best > (limits.worth_a_shift if may_shift else limits.known):
                break
            if not any({*c.index} <= {*subset} for c, _ in found):  # a pair of it
                needed = limits.known * min(alone[i] for i in subset)
                keep(*_best_formula(moments, subset, low, span, limits, needed))
    for log in (False, True):
        if len(plain) > 3 and (not log or (low[list(open_parameters)] > 0).all()):
            terms = [Term(i, log=log) for i in open_parameters]
            c, s = moments(terms)
            for vector in _eigenvectors(c, s)[1].T:
                combination = rounded(terms, vector, c, s, limits)
                keep(
                    combination, width(combination.weight, *moments(combination.terms))
                )
    return found


def _ranked(
    moments: Moments, indices: Sequence[int], size: int, low: Array
) -> list[tuple[float, tuple[int, ...]]]:
    """Return subsets of parameters and their smallest width, smallest first."""
    best: dict[tuple[int, ...], float] = {}
    for log in (False, True):
        usable = [i for i in indices if not log or low[i] > 0]
        subsets = [*itertools.combinations(range(len(usable)), size)]
        if not subsets:
            continue
        widths = _widths([Term(i, log=log) for i in usable], np.array(subsets), moments)
        for subset, own in zip(subsets, widths.tolist(), strict=True):
            key = tuple(usable[k] for k in subset)
            best[key] = min(own, best.get(key, np.inf))
    return sorted((own, subset) for subset, own in best.items())


def _widths(terms: Sequence[Term], subsets: Array, moments: Moments) -> Array:
    """Return the smallest width of a combination of each subset of terms."""
    rows, columns = subsets[:, :, None], subsets[:, None, :]
    return _eigenvectors(*(m[rows, columns] for m in moments(terms)))[0][:, 0]


def _eigenvectors(covariance: Array, prior: Array) -> tuple[Array, Array]:
    """Return widths, smallest first, and the weights of each as a column, (..., m)."""
    scale = np.sqrt(np.einsum("...ii->...i", prior))
    units = scale[..., :, None] * scale[..., None, :]
    whole = prior / units + 1e-9 * np.eye(prior.shape[-1])
    inverse = np.linalg.inv(np.linalg.cholesky(whole))
    turned = inverse.swapaxes(-1, -2)
    values, vectors = np.linalg.eigh(inverse @ (covariance / units) @ turned)
    return np.sqrt(values.clip(0)), (turned @ vectors) / scale[..., None]


def _best_formula(
    moments: Moments,
    subset: tuple[int, ...],
    low: Array,
    span: Array,
    limits: FormulaSettings,
    needed: float,
) -> tuple[Combination, float]:
    """Return the simplest formula about as narrow as the best, and its width."""
    tried = [_fitted(terms, moments, limits) for terms in _forms(subset, low)]
    if len(subset) == 2:
        tried += _shifted(moments, subset, low, span, limits, needed)
    widths = [
        width(combination.weight, *moments(combination.terms)) for combination in tried
    ]
    limit = max(limits.about_as_good * min(widths), limits.floor)
    good = [pair for pair in zip(tried, widths, strict=True) if pair[1] <= limit]
    return min(good, key=lambda pair: (pair[0].complexity, pair[1]))


def _fitted(
    terms: Sequence[Term], moments: Moments, limits: FormulaSettings
) -> Combination:
    """Return the combination of terms with the smallest width, rounded."""
    c, s = moments(terms)
    return rounded(terms, _eigenvectors(c, s)[1][:, 0], c, s, limits)


def _forms(subset: tuple[int, ...], low: Array) -> Iterator[list[Term]]:
    """Sums and products; of pairs also products with an exponential."""
    for logs in itertools.product((False, True), repeat=len(subset)):
        terms = [Term(i, log=log) for i, log in zip(subset, logs, strict=True)]
        is_one_kind = len(subset) == 2 or len({*logs}) == 1
        if is_one_kind and all(low[t.index] > 0 or not t.log for t in terms):
            yield terms


def _shifted(
    moments: Moments,
    subset: tuple[int, ...],
    low: Array,
    span: Array,
    limits: FormulaSettings,
    needed: float,
    *,
    refined: int = 3,
) -> Iterator[Combination]:
    """Products in which one of two parameters has a number added.

    These are the best shift of each parameter and rounder ones, if the best gives a
    width that is small enough. Shifts between its neighbors are then tried so many
    times that the last are some thousandths of the range apart.
    """
    for i, other in (subset, subset[::-1]):
        if low[other] <= 0:
            continue
        sizes = span[i] * np.array(limits.shifts)
        shifts = np.sort(np.concatenate([-sizes, sizes]))
        shifts = shifts[shifts > -low[i] + 0.02 * span[i]]
        best, least = 0.0, np.inf
        for _ in range(1 + refined):
            moved = [Term(i, log=True, shift=float(shift)) for shift in shifts]
            at = np.stack([np.zeros(len(shifts), int), 1 + np.arange(len(shifts))], 1)
            widths = _widths([Term(other, log=True), *moved], at, moments)
            k = int(widths.argmin())
            best, least = float(shifts[k]), float(widths[k])
            ends = shifts[max(k - 1, 0)], shifts[min(k + 1, len(shifts) - 1)]
            shifts = np.linspace(*ends, 2 * len(limits.shifts))
        if least > limits.as_good * max(needed, limits.floor):
            continue
        for shift in np.concatenate([*roundings(np.array([best]))]).tolist():
            if shift > -low[i] + 0.01 * span[i]:
                each = (Term(j, log=True, shift=shift * (j == i)) for j in subset)
                yield _fitted([*each], moments, limits)


def width(weight: Array, covariance: Array, prior: Array) -> float:
    """Return the standard deviation of a combination in those of the prior."""
    size = weight @ prior @ weight
    return float(np.sqrt(max(weight @ covariance @ weight, 0.0) / size))


def rounded(
    terms: Sequence[Term],
    weight: Array,
    covariance: Array,
    prior: Array,
    limits: FormulaSettings,
) -> Combination:
    """Return the combination of the roundest weights that are about as narrow.

    The first weight is 1.
    """
    limit = max(limits.as_good * width(weight, covariance, prior), limits.floor)
    size = np.abs(weight) * np.sqrt(prior.diagonal())
    first = 0 if size[0] > 0.1 * size.max() else int(size.argmax())
    weight = weight / weight[first]
    good = (w for w in roundings(weight) if width(w, covariance, prior) <= limit)
    weight = next(good, weight)
    has_halves = (2 * weight % 1 == 0).all() and (weight % 1 != 0).any()
    if has_halves and all(t.log for t in terms):
        weight = 2 * weight  # a^2 * b rather than a * b^0.5
    pairs = zip(terms, weight, strict=True)
    return Combination(tuple(replace(t, weight=float(w)) for t, w in pairs if w))


def roundings(values: Array) -> Iterator[Array]:
    """Return numbers near some, the roundest first, these to four digits last.

    Small numbers may vanish if there are four or more.
    """
    yield np.copysign(1.0, values)
    simple = np.array([*SIMPLE, 0.0] if len(values) > 3 else SIMPLE)
    nearest = np.abs(np.abs(values)[:, None] - simple).argmin(1)
    yield np.copysign(simple[nearest], values)
    for digits in (1, 2, 3, 4):
        yield np.array([float(f"{value:.{digits}g}") for value in values])

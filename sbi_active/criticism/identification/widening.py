"""How far draws are off: as trials disagree, and beside bounds of the prior."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2, norm, rankdata

from sbi_active.arrays import Array
from sbi_active.criticism.identification.fitting import Fitted
from sbi_active.criticism.linear.processes import parts_of


@dataclass(frozen=True)
class Spread:
    """The disagreement between parts of the trials.

    Attributes:
        p_value: p-value of each parameter being the same in all parts, shape (d,).
        deviation: Deviation of the parts from their mean, as far as it is none of their
            errors, shape (f, d), such that normal multiples of them add up to the
            spread.
        sd: Standard deviation of each parameter by all trials if it had no bounds,
            shape (d,).
    """

    p_value: Array
    deviation: Array
    sd: Array

    def widen(self, u: Array, by: float, rng: np.random.Generator) -> Array:
        """Return draws (n, d) as far off as the parts are from each other, times by."""
        weight = rng.standard_normal((len(u), len(self.deviation)))
        return u + by * weight @ self.deviation


def spread(found: Fitted, fewest: int) -> Spread:
    """Return the disagreement of parts of the trials about theta.

    Args:
        found: The model, linear.
        fewest: Number of parts at least.
    """
    draws, m, own = found.draws, found.measurements, found.rival.theta_dim
    likely = np.append(draws.present.mean(0) > 0.5, True)
    free = (found.rival.coordinates.trial_of() < 0) & likely[found.effect]
    parts = parts_of(m, fewest, fewest)
    white = found.whitened(found.model().rows[:, np.append(True, free)], parts)
    each = [white[parts == f] for f in range(int(parts.max()) + 1)]
    grams = np.stack([rows.T @ rows for rows in each])
    precision, linear = grams[:, 1:, 1:], grams[:, 1:, 0]
    total = precision.sum(0)
    ridge = np.diag(1e-6 * np.diag(total) + 1e-12)
    best = np.linalg.solve(total + ridge, linear.sum(0))
    cov = np.linalg.inv(precision + ridge)
    each = best + np.einsum("fij,fj->fi", cov, linear - precision @ best)
    each, sd = each[:, :own], np.sqrt(np.einsum("fii->fi", cov))[:, :own]
    weight = 1 / sd**2
    mean = (weight * each).sum(0) / weight.sum(0)
    square, freedom = (weight * (each - mean) ** 2).sum(0), len(each) - 1
    of_parts = weight.sum(0) - (weight**2).sum(0) / weight.sum(0)
    variance = np.maximum(square - freedom, 0.0) / np.maximum(of_parts, 1e-300)
    # Deviations that are far off by their errors count less.
    off = np.sqrt(weight) * (each - mean)
    off = off / np.maximum(np.linalg.norm(off, axis=0), 1e-300)
    p_value = chi2.sf(square, max(freedom, 1))
    whole = np.sqrt(np.diag(np.linalg.inv(total + ridge)))[:own]
    return Spread(p_value, off * np.sqrt(variance), whole)


def reflected(u: Array, low: Array, high: Array) -> Array:
    """Return draws that left the bounds as far inside of them."""
    u = np.where(u < low, 2 * low - u, u)
    u = np.where(u > high, 2 * high - u, u)
    return np.clip(u, low, high)


def opened(inside: Array, sd: float, half: float) -> Array:
    """Return distances of draws from a bound, as half a Gaussian at least, (n,).

    Where trials ask for what is far beyond it, the posterior within has no width, which
    says nothing of the parameter.

    Args:
        inside: Distances from the bound, shape (n,).
        sd: Deviation that the parameter has without bounds.
        half: Share of it that is wide enough.
    """
    if inside.std() >= half * sd:
        return inside
    probability = (rankdata(inside, "ordinal") - 0.5) / len(inside)
    return np.maximum(inside, sd * norm.ppf(0.5 + probability / 2))

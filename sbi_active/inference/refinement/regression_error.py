r"""How far a belief may be off, since its regressions rest on few simulations.

A coefficient has the error :math:`E \sim \mathcal N(0, (F^\top F)^{-1} \otimes S)`, so
a log likelihood is off by some :math:`\delta(z)`, and the belief, to second order, by

.. math::
    \mathrm{KL} \approx \tfrac12\, \mathrm{Var}_{z \sim b}\big(\delta(z)\big)

nats. That grows with the numbers in an outcome and with the parameters, and shrinks
with the simulations and their spread over the posterior's. So where it is large,
simulations from further off are of use: they are taken as far as the basis still says
there what those nearby say, within their error.

References:
    Hausman, Econometrica 1978 (an estimate against a safer one); Lepski, Theory Probab.
    Appl. 1991 (the widest neighbourhood that agrees with the narrower ones).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from sbi_active.inference.regression.histories import Histories
from sbi_active.inference.regression.regions import around
from sbi_active.inference.regression.surrogate import MISFIT, LocalRegression, Surrogate

Array = NDArray[Any]

LARGE = 0.2  # nats that the belief is off
NUM_REPEATS = 20  # of the coefficients


def expected_error(
    surrogate: Surrogate,
    draws: Array,
    rng: np.random.Generator,
    *,
    explained: bool = False,
    num_places: int = 400,
) -> float:
    """Return the expected divergence from the belief of endless simulations, in nats.

    Over draws of the belief (n, d). Where they shall be ``explained``, observations
    that lie further out than simulations are moved to where those lie, so that the
    error is that of the simulations alone.
    """
    draws = draws[:: max(len(draws) // num_places, 1)]
    label = surrogate.assign(draws)
    change = np.zeros((NUM_REPEATS, len(draws)))
    for k, fit in enumerate(surrogate.regressions):
        rows = np.flatnonzero(label == k)
        if len(rows):
            change[:, rows] = _changes(fit, draws[rows], rng, explained=explained)
    return _nats(change[:, label >= 0])


def widened(
    histories: Histories,
    surrogate: Surrogate,
    error: float,
    draws: Array,
    rng: np.random.Generator,
    *,
    pieces: float = 0.03,
    chance: float = 0.99,
    reaches: tuple[float, ...] = (2.0, 4.0, 8.0, 16.0, 32.0, 64.0),
) -> tuple[Surrogate, float]:
    """Return the surrogate of more distant simulations that agree, which errs least.

    Beside it, what it may err beyond its expected error, in nats, as it differs from
    the one given by more than that one's error.

    Args:
        histories: Simulations.
        surrogate: Likelihood of the simulations nearby.
        error: Its expected error, nats.
        draws: Draws of its belief, shape (n, d).
        rng: Source of chance.
        pieces: Expected error, nats, beyond which one regression is tried in place of
            several. At half a banana is .03 nats further off, by its ends; at twice
            skewed noise leaves some beliefs in pieces.
        chance: Probability of agreement where only chance makes a difference.
        reaches: Multiples of a region's radius that are tried.
    """
    best, least, bias = surrogate, error, 0.0
    # The difference from a better surrogate is chi-squared, of as many degrees as there
    # are parameters.
    dim = draws.shape[1]
    allowed = error * chi2.ppf(chance, dim) / dim
    near = surrogate.log_likelihood(draws)
    num_rows = int(histories.valid.sum())
    wider = [([fit.region for fit in surrogate.regressions], np.array(reaches))]
    if len(surrogate.regressions) > 1 and error > pieces:
        one = around(draws)
        reach = 1.01 * max(1.0, float(one.distance(draws).max()))
        wider.insert(0, ([one], reach * np.array([1.0, *reaches])))
    for regions, factors in wider:
        for factor in factors if best is surrogate else ():
            fits = [histories.regress(region.wider(factor)) for region in regions]
            wide = [fit for fit in fits if fit is not None and fit.excess <= MISFIT]
            if len(wide) < len(fits):
                break
            other = Surrogate(surrogate.coordinates, wide, surrogate.is_cautious)
            difference = _nats(other.log_likelihood(draws) - near)
            if not difference <= allowed:
                break
            found = expected_error(other, draws, rng)
            if found < least:
                best, least, bias = other, found, max(difference - error, 0.0)
            if min(len(fit.residual) for fit in wide) == num_rows:
                break  # further off there is nothing
    return best, bias


def _changes(
    fit: LocalRegression, z: Array, rng: np.random.Generator, *, explained: bool
) -> Array:
    """Return what other coefficients would add to log likelihoods, (repeats, n)."""
    features = fit.basis(fit.region.scaled(z))
    rotated = features @ fit.root
    error = features @ fit.coefficient
    (p, q), freedom = fit.coefficient.shape, len(fit.residual) - len(fit.root)
    widening = 1 + (rotated**2).sum(1)
    scale = -0.5 * fit.covariance.precision / widening
    if explained:
        usual = np.sqrt(max(fit.used.sum(), 1) * widening / fit.covariance.precision)
        length = np.linalg.norm(error, axis=1)
        error *= (usual / np.maximum(length, usual))[:, None]
    changes = []
    for _ in range(NUM_REPEATS):
        step = rotated @ (rng.standard_normal((p, q)) * fit.used)
        variance = rng.standard_normal(q) * (2 / freedom) ** 0.5
        square = (step * (step + 2 * error)).sum(1) + error**2 @ variance
        changes.append(scale * square)
    return np.stack(changes)


def _nats(change: Array) -> float:
    """Return half the variance along the last axis, meaned over the others."""
    return 0.5 * float(change.var(-1).mean()) if change.size else np.inf

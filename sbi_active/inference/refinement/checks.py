r"""How far a regression may be trusted, by its simulations and by fresh ones.

It rests on few simulations. A coefficient has the error
:math:`E \sim \mathcal N(0, (F^\top F)^{-1} \otimes S)`, so a log likelihood is off by
some :math:`\delta(z)`, and the belief, to second order, by

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

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2, kurtosis

from sbi_active.arrays import Array
from sbi_active.inference.refinement.stages import Stage, StageSettings
from sbi_active.inference.regression.histories import Histories
from sbi_active.inference.regression.regions import around
from sbi_active.inference.regression.surrogate import LocalRegression, Surrogate


def expected_error(
    surrogate: Surrogate,
    draws: Array,
    rng: np.random.Generator,
    *,
    explained: bool = False,
    num_places: int = 400,
    num_repeats: int = 20,
) -> float:
    """Return the expected divergence from the belief of endless simulations, in nats.

    Over draws of the belief (n, d). Where they shall be ``explained``, observations
    that lie further out than simulations are moved to where those lie, so that the
    error is that of the simulations alone. Numbers of places and of repeated
    coefficients are a choice.
    """
    draws = draws[:: max(len(draws) // num_places, 1)]
    label = surrogate.assign(draws)
    change = np.zeros((num_repeats, len(draws)))
    for k, fit in enumerate(surrogate.regressions):
        rows = np.flatnonzero(label == k)
        if len(rows):
            own = rng, num_repeats, explained
            change[:, rows] = _changes(fit, draws[rows], *own)
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
            wide = [fit for fit in fits if fit is not None and not fit.has_misfit]
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
    fit: LocalRegression,
    z: Array,
    rng: np.random.Generator,
    num_repeats: int,
    explained: bool,
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
    for _ in range(num_repeats):
        step = rotated @ (rng.standard_normal((p, q)) * fit.used)
        variance = rng.standard_normal(q) * (2 / freedom) ** 0.5
        square = (step * (step + 2 * error)).sum(1) + error**2 @ variance
        changes.append(scale * square)
    return np.stack(changes)


def _nats(change: Array) -> float:
    """Return half the variance along the last axis, meaned over the others."""
    return 0.5 * float(change.var(-1).mean()) if change.size else np.inf


def noise_tails(
    stages: list[Stage], own: StageSettings, *, light: float = -0.3
) -> tuple[float, bool]:
    r"""Return the excess kurtosis of residuals, and whether they may have hard edges.

    Of all stages: a few hundred numbers tell by it (-1.2 for uniform noise, 0 for
    Gaussian, below ``light`` where it has edges) what no mixture of normal
    distributions follows. Its standard error is :math:`\sqrt{24 / n}` for Gaussian
    numbers (Fisher, Proc. Lond. Math. Soc. 1930). Regressions with misfit are left out,
    whose error has edges too.
    """
    residuals = [
        fit.standardized[:, fit.standardized.var(0) > 1e-6].ravel()
        for stage in stages
        for fit, mass in zip(stage.surrogate.regressions, stage.mass, strict=True)
        if mass > own.live and not fit.has_misfit
    ]
    values = np.concatenate([np.zeros(0), *residuals])
    if values.size < 100:
        return 0.0, False
    margin = 3.5 * np.sqrt(24 / values.size)
    return float(kurtosis(values)), bool(kurtosis(values) < light - margin)


@dataclass(frozen=True)
class Fresh:
    """What simulations that no regression was fitted to say of it.

    Attributes:
        tails: Tail probability of each trial and, last, of all.
        shift: Largest error of a mean, in standard deviations of the belief.
        limit: Largest shift of a belief that is to be trusted.
        correlation: Correlation of their errors across trials.
        least: Squares of the observed trials at the draw that explains them best, (t,).
    """

    tails: list[float]
    shift: float
    limit: float
    correlation: float
    least: Array


def compared_with_fresh(
    surrogate: Surrogate,
    z: Array,
    x: Array,
    num_trials: int,
    own: StageSettings,
    *,
    least: float = 2e-5,
) -> Fresh:
    r"""Compare a surrogate with simulations at draws of its belief.

    A tail probability is how often these miss their prediction by more than reality,

    .. math::
        P\big(D(x, \theta) \ge D(x_o, \theta)\big), \quad \theta \sim b,\;
        x \sim p(x | \theta), \quad D = |L^{-1} (x - B^\top f)|^2,

    and the shift what their mean error would move a least-squares fit by.

    Args:
        surrogate: Learned likelihood.
        z: Draws of the belief, shape (n, d).
        x: Outcomes there less the observed ones, shape (n, q).
        num_trials: Trials stacked in q.
        own: Settings of the check.
        least: Tail probability that so few simulations may tell.

    References:
        Gelman, Meng & Stern, Statistica Sinica 1996 (realized discrepancies).
    """
    d, sds = z.shape[1], z.std(0) + 1e-300
    label = surrogate.assign(z)
    if (label >= 0).sum() <= 10:
        tails = [1.0] * (num_trials + 1)
        return Fresh(tails, np.inf, own.largest_shift, 0.0, np.zeros(num_trials))
    real, known, errors, moves = [], [], [], []
    for k in np.unique(label[label >= 0]):
        fit, here = surrogate.regressions[k], z[label == k]
        predicted, widening = fit.whitened(here)
        error = fit.whitened_outcomes(x[label == k]) - predicted
        # A little leverage is the price of few rows; much of it is extrapolation, which
        # must not excuse a misfit.
        most = np.minimum(widening, 2.0)[:, None]
        real.append(_squares(predicted, num_trials) / most)
        known.append(_squares(error, num_trials) / widening[:, None])
        axes = own.step * np.diag(sds)
        moved = [fit.whitened(here + axis)[0] - predicted for axis in axes]
        slope = np.stack(moved, 2) / (own.step * sds)
        system = np.einsum("nqj,nqk->njk", slope, slope) + own.flat * np.eye(d)
        score = np.einsum("nqj,nq->nj", slope, error)
        moves.append(np.linalg.solve(system, score[..., None])[..., 0] / sds)
        errors.append(error / np.sqrt(widening)[:, None])
    observed, simulated, error, move = map(np.concatenate, (real, known, errors, moves))
    pairs = zip(simulated.T, observed.T, strict=True)
    tail = [float(_exceedance(*pair).mean().clip(least, 1.0)) for pair in pairs]
    worst = int(np.abs(move.mean(0)).argmax())
    deviation = float(move[:, worst].std() / np.sqrt(len(move)))
    return Fresh(
        tail,
        float(np.abs(move.mean(0))[worst]),
        max(own.largest_shift, own.chance * deviation),
        _across(error, num_trials),
        observed[observed[:, -1].argmin(), :-1],
    )


def _across(error: Array, num_trials: int) -> float:
    """Return the root mean square correlation of numbers (n, q) of unlike trials."""
    n, q = error.shape
    varies = error.std(0) > 0
    if num_trials == 1 or not varies.any():
        return 0.0
    trial = np.repeat(np.arange(num_trials), q // num_trials)[varies]
    correlation = np.corrcoef(error[:, varies].T).reshape(len(trial), len(trial))
    apart = correlation[trial[:, None] != trial]
    return float(max((apart**2).mean() - 1 / n, 0.0) ** 0.5) if apart.size else 0.0


def _exceedance(known: Array, value: Array) -> Array:
    r"""Return the probability that a further draw is as large, shape (m,).

    Among n known draws it is a rank. Ranks end at 1 / (n + 1), so that beyond the
    largest k the excess y over a threshold is taken for generalized Pareto,

    .. math::
        P(y) = (1 + \xi y / \bar y)^{-1 / \xi}, \qquad
        \xi = \tfrac12 (1 - \bar y^2 / s^2) \ge 1 / k,

    of their mean and variance. The least :math:`\xi` allows for a mean of k alone,
    exactly so where the tail is exponential.

    References:
        Hosking & Wallis, Technometrics 1987 (moments); Knijnenburg et al.,
        Bioinformatics 2009 (tails of permutation tests).
    """
    ordered, n = np.sort(known), len(known)
    k = max(n // 10, 5)
    threshold = ordered[-k - 1]
    excess = ordered[-k:] - threshold + 1e-12 * (1 + threshold)
    mean = excess.mean()
    shape = max(0.5 * (1 - mean**2 / (excess.var(ddof=1) + 1e-300)), 1 / k)
    beyond = (value - threshold).clip(0.0) / mean
    tail = (k + 1) / (n + 1) * (1 + shape * beyond) ** (-1 / shape)
    rank = (n - np.searchsorted(ordered, value) + 1) / (n + 1)
    return np.where(value > threshold, tail, rank)


def _squares(whitened: Array, num_trials: int) -> Array:
    """Return squared lengths of each trial's part and of all, shape (n, t + 1)."""
    parts = (whitened.reshape(len(whitened), num_trials, -1) ** 2).sum(-1)
    return np.concatenate([parts, parts.sum(1, keepdims=True)], 1)


def outcomes_at(
    surrogate: Surrogate, draws: Array, pool: Histories, own: StageSettings
) -> tuple[list[float], float]:
    r"""Return the probability of each trial's outcome, and how blurred that is.

    :math:`E_b[P(\text{as observed} | \theta)]` over draws of the belief (n, d). Near
    zero, the trial did what simulations near the belief seldom do: the simulator lacks
    a way of failing, or a fault was told as "invalid". The other compares repeated
    simulations: where those agree and the regression expects them to differ, it misses
    an edge.
    """
    share = pool.agrees.mean(0)
    # A trial in which simulations all agree, or none does, was not regressed.
    total = np.where((share > 0) & (share < 1), 0.0, share * len(draws))
    label = surrogate.assign(draws)
    blur = 0.0
    for k, fit in enumerate(surrogate.regressions):
        z = draws[label == k]
        for outcome in fit.outcomes:
            total[outcome.trial] += np.exp(outcome.log_prob(z)).sum()
            if len(z) > own.live * len(draws):
                blur = max(blur, outcome.blur)
    return [float(p) for p in total / len(draws)], float(blur)

"""What simulations and observations say of a regression."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import kurtosis

from sbi_active.inference.beliefs.diagnostics import Assumption, Diagnostics
from sbi_active.inference.refinement.course import LIVE, Stage
from sbi_active.inference.regression.histories import Histories
from sbi_active.inference.regression.surrogate import LocalRegression, Surrogate

Array = NDArray[Any]

BLURRED = 0.05  # share of repeated simulations that would differ, beyond those that do


def noise_shape(
    fits: list[LocalRegression],
    left: float,
    rng: np.random.Generator,
    *,
    hard: float = 0.03,
) -> tuple[float, bool]:
    r"""Return the negentropy of the residuals, nats a number, and whether it is chance.

    .. math::
        J = H[\mathcal N(0, s^2)] - H[e],

    with H from the spacings of the sorted residuals, calibrated on Gaussian numbers,
    for each outcome and for all together: .18 for uniform noise, .42 for exponential.
    Of noise that is taken for a mixture it is that of the residuals' normal scores,
    which may have ``left`` so much. A Gaussian may lose ``hard`` nats a number.

    References:
        Vasicek, J. R. Stat. Soc. B 1976.
    """
    if not fits:
        return np.inf, False
    residual = np.concatenate(
        [fit.standardized if fit.shape is None else fit.shape.score for fit in fits]
    )
    residual = residual[:, residual.var(0) > 1e-6]  # a constant outcome has no noise
    if residual.size == 0:
        return 0.0, True
    columns = [*residual.T, residual.ravel()]
    excess, clear = [], []
    for size, members in (
        (len(residual), columns[:-1]),
        (residual.size, columns[-1:]),
    ):
        chance = [_negentropy(rng.standard_normal(size)) for _ in range(20)]
        mean, deviation = np.mean(chance), np.std(chance)
        for member in members:
            excess.append(_negentropy(member) - mean)
            clear.append(excess[-1] > hard + 4 * deviation)
    if any(fit.shape is not None for fit in fits):
        # One mixture serves all numbers: what counts is what they lose together.
        mean = max(float(np.mean(excess)), 0.0)
        return mean, mean <= left
    return float(max(*excess, 0.0)), not any(clear)


def has_hard_edges(stages: list[Stage], *, light: float = -0.3) -> bool:
    r"""Return whether the residuals of all stages have lighter tails than a Gaussian.

    A few hundred numbers tell by their kurtosis (-1.2 for uniform noise, 0 for
    Gaussian, below ``light`` where it has edges) what their entropy cannot tell yet.
    Its standard error is :math:`\sqrt{24 / n}` for Gaussian numbers (Fisher, Proc.
    Lond. Math. Soc. 1930). Regressions with misfit are left out, whose error has edges
    too.
    """
    residuals = [
        fit.standardized[:, fit.standardized.var(0) > 1e-6].ravel()
        for stage in stages
        for fit, mass in zip(stage.surrogate.regressions, stage.mass, strict=True)
        if mass > LIVE and not fit.has_misfit
    ]
    values = np.concatenate([np.zeros(0), *residuals])
    if values.size < 100:
        return False
    margin = 3.5 * np.sqrt(24 / values.size)
    return bool(kurtosis(values) < light - margin)


def _negentropy(values: Array) -> float:
    n = len(values)
    m = max(1, int(n**0.5 / 2))
    ordered = np.sort(values)
    spacing = ordered[2 * m :] - ordered[: -2 * m]
    entropy = np.log(spacing * n / (2 * m) + 1e-300).mean()
    return float(0.5 * np.log(2 * np.pi * np.e * values.var()) - entropy)


def trial_correlation(
    fits: list[LocalRegression], num_trials: int, *, correlated: float = 0.25
) -> tuple[float, bool]:
    """Return the correlation of residuals across trials, and whether it is low.

    Misfit below its limit reaches half of what counts as ``correlated``.
    """
    if num_trials == 1 or not fits:
        return 0.0, True
    excess, count = 0.0, 0
    for fit in fits:
        n, q = fit.standardized.shape
        freedom = n - len(fit.root)
        correlation = fit.standardized.T @ fit.standardized / freedom
        apart = np.kron(np.eye(num_trials), np.ones((q // num_trials,) * 2)) == 0
        apart &= np.outer(fit.used, fit.used)
        excess += (correlation[apart] ** 2 - 1 / freedom).sum()
        count += int(apart.sum())
    if count == 0:
        return 0.0, True
    correlation = max(excess / count, 0.0) ** 0.5
    has_misfit = any(fit.has_misfit for fit in fits)  # which correlates as well
    return float(correlation), correlation < correlated or has_misfit


def tail_probability(
    surrogate: Surrogate, draws: Array, num_trials: int, *, least: float = 2e-5
) -> tuple[list[float], float]:
    r"""Return how often a simulation misses its prediction by more than reality does.

    .. math::
        P\big(D(x, \theta) \ge D(x_o, \theta)\big), \quad \theta \sim b,\;
        x \sim p(x | \theta), \quad D = |L^{-1} (x - B^\top f)|^2,

    a trial and for all trials, with draws (m, d) of the belief b. The simulations' x
    are their residuals by a fit without them, since reality was not fitted to either.

    References:
        Gelman, Meng & Stern, Statistica Sinica 1996 (realized discrepancies).
    """
    label = surrogate.assign(draws)
    beyond, count = np.zeros(num_trials + 1), 0
    for k, fit in enumerate(surrogate.regressions):
        z = draws[label == k]
        if len(z) == 0:
            continue
        error, widening = fit.whitened(z)
        # A little leverage is the price of few rows; much of it is extrapolation, which
        # must not excuse a misfit.
        observed = _squares(error, num_trials) / np.minimum(widening, 2.0)[:, None]
        simulated = _held_out(fit, num_trials)
        pairs = zip(simulated.T, observed.T, strict=True)
        beyond += [_exceedance(known, value).sum() for known, value in pairs]
        count += len(z)
    tail = (beyond / max(count, 1)).clip(least, 1.0)
    return [float(p) for p in tail[:-1]], float(tail[-1])


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


def _held_out(fit: LocalRegression, num_trials: int) -> Array:
    r"""Return the squares of simulations by a fit without them, shape (n, t + 1).

    With f the degrees of freedom, :math:`e_i` a residual over
    :math:`\sqrt{1 - h_i}`, S its covariance, and :math:`\lambda, \mu` the shrinkage
    within and across trials, the covariance without it is

    .. math::
        S_{-i} = \tfrac{f}{f - 1} \big(S - \tfrac{1 - \mu}{f} e_i e_i^\top
        - \tfrac{\mu - \lambda}{f} \sum_k e_{ik} e_{ik}^\top
        - \tfrac{\lambda}{f} \operatorname{diag}(e_i^2)\big),

    inverted exactly (Sherman & Morrison, Ann. Math. Stat. 1950) but for the last term,
    of one number among many rows, which counts to first order.
    """
    freedom = len(fit.residual) - len(fit.root)
    within, across = fit.covariance.shrinkage
    apart = 1 / np.sqrt((1 - fit.leverage).clip(1e-6))[:, None]
    if across == 1:  # trials have nothing in common
        square = _squares(apart * fit.residual, num_trials)[:, :-1]
        square = square / (1 - (1 - within) * square / freedom).clip(1e-6)
    else:
        square = _held_out_jointly(fit, apart, num_trials)
    fourth = _squares((apart * fit.standardized) ** 2, num_trials)[:, :-1]
    square = (square + within * fourth / freedom) * (freedom - 1) / freedom
    return np.concatenate([square, square.sum(1, keepdims=True)], 1)


def _held_out_jointly(fit: LocalRegression, apart: Array, num_trials: int) -> Array:
    """Return squares of each trial given those before, less the last term, (n, t)."""
    n, size = fit.residual.shape
    covariance, freedom = fit.covariance, n - len(fit.root)
    within, across = covariance.shrinkage
    trial = np.repeat(np.arange(num_trials), size // num_trials)[fit.used]
    residual = apart * fit.standardized[:, fit.used] * covariance.deviation
    own = [covariance.whiten(residual * (trial == k)) for k in range(num_trials)]
    common = np.full((num_trials, 1), np.sqrt((1 - across) / freedom))
    weight = np.sqrt(max(across - within, 0.0) / freedom) * np.eye(num_trials)
    factor = np.concatenate([common, weight], 1)
    product = np.zeros((n, num_trials, num_trials))  # whitened, of the trials so far
    total = [np.zeros(n)]
    for k in range(num_trials):
        block = np.stack([part[:, trial == k] for part in own], 1)
        product += block @ block.swapaxes(1, 2)
        row = product.sum(1) @ factor
        kept = (1 + 1e-9) * np.eye(num_trials + 1) - factor.T @ product @ factor
        gain = (row * np.linalg.solve(kept, row[..., None])[..., 0]).sum(1)
        total.append(product.sum((1, 2)) + gain)
    return np.diff(np.stack(total, 1), axis=1)


def _squares(whitened: Array, num_trials: int) -> Array:
    """Return squared lengths of each trial's part and of all, shape (n, t + 1)."""
    parts = (whitened.reshape(len(whitened), num_trials, -1) ** 2).sum(-1)
    return np.concatenate([parts, parts.sum(1, keepdims=True)], 1)


def check_outcomes(
    diagnostics: Diagnostics,
    surrogate: Surrogate,
    draws: Array,
    pool: Histories,
    *,
    rare: float = 0.01,
) -> Diagnostics:
    r"""Return a belief's diagnostics with figures on trials without a measurement.

    ``probability_of_outcome`` is :math:`E_b[P(\text{as observed} | \theta)]` of each
    trial, over draws of the belief (n, d). Near zero, the trial did what simulations
    near the belief seldom do (less often than ``rare``): the simulator lacks a way of
    failing, or a fault was told as "invalid". The assumption "outcomes_followed"
    compares repeated simulations: where those agree and the regression expects them to
    differ, it misses an edge.
    """
    share = pool.agrees.mean(0) if len(pool) else np.ones(0)
    # A trial in which simulations all agree, or none does, was not regressed.
    total = np.where((share > 0) & (share < 1), 0.0, share * len(draws))
    label = surrogate.assign(draws)
    blur = 0.0
    for k, fit in enumerate(surrogate.regressions):
        z = draws[label == k]
        for outcome in fit.outcomes:
            total[outcome.trial] += np.exp(outcome.log_prob(z)).sum()
            if len(z) > LIVE * len(draws):
                blur = max(blur, outcome.blur)
    probability = [float(p) for p in total / len(draws)]
    followed = blur <= BLURRED
    texts = []
    if not followed:
        texts.append(
            "SA120 where simulations have a measurement and where they have none is "
            f"followed coarsely ({blur:.0%} of repeated simulations would differ that "
            "do not), so that the belief is too wide; raise num_histories"
        )
    unheard = [k for k, p in enumerate(probability) if p < rare]
    if unheard:
        texts.append(
            f"SA121 trials {', '.join(map(str, unheard))} had a measurement, or none, "
            f"where less than {rare:.0%} of the simulations near the belief do the "
            "same: the simulator lacks a way to fail, or the status of the trial is "
            "wrong"
        )
    assumption = Assumption(followed, float(blur))
    return diagnostics.extended(
        probability_of_outcome=probability,
        num_missing=pool.num_missing,
        assumptions={**diagnostics.assumptions, "outcomes_followed": assumption},
    ).warned(*texts)

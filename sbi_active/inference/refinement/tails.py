"""How far the observations lie from what simulations at the belief give."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sbi_active.inference.regression.surrogate import LocalRegression, Surrogate

Array = NDArray[Any]

RESOLUTION = 2e-5  # least tail probability


def tail_probability(
    surrogate: Surrogate, draws: Array, num_trials: int
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
    tail = (beyond / max(count, 1)).clip(RESOLUTION, 1.0)
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

"""What residuals of regressions say of the noise, and of trials that share it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import kurtosis

from sbi_active.inference.refinement.course import Stage
from sbi_active.inference.refinement.trust import LIVE
from sbi_active.inference.regression.surrogate import LocalRegression

Array = NDArray[Any]

HARD_NOISE = 0.03  # nats a number that a Gaussian loses on the noise
LIGHT_TAILS = -0.3  # excess kurtosis; -1.2 for uniform noise, 0 for Gaussian
CORRELATED = 0.25  # across trials; misfit below MISFIT reaches half of it


def noise_shape(
    fits: list[LocalRegression], left: float, rng: np.random.Generator
) -> tuple[float, bool]:
    r"""Return the negentropy of the residuals, nats a number, and whether it is chance.

    .. math::
        J = H[\mathcal N(0, s^2)] - H[e],

    with H from the spacings of the sorted residuals, calibrated on Gaussian numbers,
    for each outcome and for all together: .18 for uniform noise, .42 for exponential.
    Of noise that is taken for a mixture it is that of the residuals' normal scores,
    which may have ``left`` so much.

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
            clear.append(excess[-1] > HARD_NOISE + 4 * deviation)
    if any(fit.shape is not None for fit in fits):
        # One mixture serves all numbers: what counts is what they lose together.
        mean = max(float(np.mean(excess)), 0.0)
        return mean, mean <= left
    return float(max(*excess, 0.0)), not any(clear)


def has_hard_edges(stages: list[Stage]) -> bool:
    r"""Return whether the residuals of all stages have lighter tails than a Gaussian.

    A few hundred numbers tell by their kurtosis what their entropy cannot tell yet. Its
    standard error is :math:`\sqrt{24 / n}` for Gaussian numbers (Fisher, Proc. Lond.
    Math. Soc. 1930). Regressions with misfit are left out, whose error has edges too.
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
    return bool(kurtosis(values) < LIGHT_TAILS - margin)


def _negentropy(values: Array) -> float:
    n = len(values)
    m = max(1, int(n**0.5 / 2))
    ordered = np.sort(values)
    spacing = ordered[2 * m :] - ordered[: -2 * m]
    entropy = np.log(spacing * n / (2 * m) + 1e-300).mean()
    return float(0.5 * np.log(2 * np.pi * np.e * values.var()) - entropy)


def trial_correlation(
    fits: list[LocalRegression], num_trials: int
) -> tuple[float, bool]:
    """Return the correlation of residuals across trials beyond chance."""
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
    return float(correlation), correlation < CORRELATED or has_misfit

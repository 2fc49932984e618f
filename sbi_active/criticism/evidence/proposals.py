"""Where importance sampling proposes after a first round that missed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from sbi_active.criticism.evidence.importance import (
    LOOKS,
    MISSED,
    ImportanceSample,
    lower_factors,
)
from sbi_active.criticism.evidence.jumps import quadratic
from sbi_active.criticism.evidence.least_squares import Modes, along_ridges
from sbi_active.criticism.rivals.rival import Rival
from sbi_active.inference.sampling.bandwidth import scott
from sbi_active.inference.sampling.student_mixture import StudentMixture
from sbi_active.inference.sampling.tempering import largest_power
from sbi_active.inference.sampling.weights import effective_sample_size, log_sum_exp

Array = NDArray[Any]
Local = Callable[[ImportanceSample, int], StudentMixture]

#: Points of a sample near which the shape of a posterior is looked for again.
NUM_AGAIN = 48
#: Effective rows a coefficient of a regression.
PER_COEFFICIENT = 3
#: Draws from a regression, rounds of them, components that stand for them in a
#: proposal, its power of the likelihood, and the share of a normal cloud of rows
#: within which a regression is believed.
NUM_DRAWS, NUM_ADAPTED, NUM_COMPONENTS, POWER, WITHIN = 2_000, 4, 40, 0.6, 0.999


def ridges(rival: Rival, modes: Modes, step: float, rng: np.random.Generator) -> Local:
    """Return a function that proposes along what the data leave open.

    Args:
        rival: The model.
        modes: Its modes.
        step: Of finite differences.
        rng: Source of the points.
    """

    def local(sample: ImportanceSample, number: int) -> StudentMixture:
        points = None
        if number > 0:
            points = np.unique(sample.draws(NUM_AGAIN, rng), axis=0)
        return along_ridges(rival, modes, step=step, rng=rng, points=points)

    return local


def regressions(
    rival: Rival, modes: Modes, step: float, rng: np.random.Generator
) -> Local:
    """Return the same for a simulator that jumps, arguments as in :func:`ridges`.

    It proposes from a regression, and once along ridges where that keeps failing, since
    no quadratic function follows one that bends.
    """
    along = ridges(rival, modes, step, rng)

    def local(sample: ImportanceSample, number: int) -> StudentMixture:
        bends = number == LOOKS[-1] and sample.effective_sample_size < MISSED
        found = None if bends else _by_regression(rival, sample, rng)
        return along(sample, number) if found is None else found

    return local


def _by_regression(
    rival: Rival, sample: ImportanceSample, rng: np.random.Generator
) -> StudentMixture | None:
    """Return a proposal from a quadratic regression of the residuals.

    Derivatives of a simulator that jumps, of which a search makes its proposal, are
    those of the jumps, while a regression on what was simulated so far averages over
    them. It serves to propose alone: the weights are the simulator's. None where too
    few particles have an outcome.

    Args:
        rival: The model.
        sample: Its particles so far, with their weights.
        rng: Source of the draws.
    """
    u, dim = sample.u, rival.dim
    target = rival.log_prior(u)
    inside = np.isfinite(target)
    u, target = u[inside], target[inside]
    target = target + rival.log_likelihood(u)
    num = (dim + 1) * (dim + 2) // 2
    if int(np.isfinite(target).sum()) < 2 * num:
        return None
    weight = _tempered(target, min(PER_COEFFICIENT * num, 0.5 * len(u)))
    mean = weight @ u
    cov = ((u - mean) * weight[:, None]).T @ (u - mean) + 1e-12 * np.eye(dim)
    whiten = np.linalg.inv(lower_factors(cov)).T
    root = np.sqrt(weight)[:, None]
    residual = rival.residual(u)[0]
    rows = quadratic((u - mean) @ whiten)
    fit = np.linalg.lstsq(root * rows, root * residual, rcond=None)[0]
    farthest = chi2.ppf(WITHIN, dim)

    def log_posterior(at: Array) -> Array:
        z = (at - mean) @ whiten
        log_p = rival.log_prior(at)
        log_p = np.where((z**2).sum(1) < farthest, log_p, -np.inf)
        has = np.isfinite(log_p)
        log_p[has] += POWER * rival.error.log_likelihood(quadratic(z[has]) @ fit)
        return log_p

    proposal = StudentMixture(mean[None], lower_factors(cov)[None])
    for _ in range(NUM_ADAPTED):
        draws = proposal.sample(NUM_DRAWS, rng)
        log_w = log_posterior(draws) - proposal.log_prob(draws)
        if not np.isfinite(log_w).any():
            break
        w = np.exp(log_w - log_sum_exp(log_w))
        center = w @ draws
        cov = ((draws - center) * w[:, None]).T @ (draws - center)
        # Scott's width, of kernels whose mixture has the draws' covariance.
        width = scott(NUM_COMPONENTS, dim)
        kernel = lower_factors(width**2 * cov + 1e-12 * np.eye(dim))
        means = draws[rng.choice(len(draws), NUM_COMPONENTS, p=w)]
        proposal = StudentMixture(means, np.repeat(kernel[None], NUM_COMPONENTS, 0))
    return proposal


def _tempered(target: Array, effective: float) -> Array:
    """Return weights in proportion to a power of exp(target), so many effective."""
    finite = np.where(np.isfinite(target), target, -1e300)
    apart = finite - finite.max()

    def suffices(power: float) -> bool:
        return effective_sample_size(power * apart) >= effective

    w = np.exp(largest_power(suffices, least=0.0) * apart)
    return w / w.sum()

"""Evidence by tempered sequential Monte Carlo."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sbi_active.criticism.evidence.importance import ImportanceSample, lower_factors
from sbi_active.criticism.rivals.rival import Rival
from sbi_active.inference.sampling.tempering import largest_power
from sbi_active.inference.sampling.weights import (
    effective_sample_size,
    log_sum_exp,
    systematic,
)

Array = NDArray[Any]

#: A choice: each move of each particle costs a simulation of every trial.
NUM_PARTICLES, NUM_MOVES = 400, 4
#: The prior's sample, from which the particles are the first selection, by particle.
PRIOR_SHARE = 4
#: Share of the particles that a step of the temperature leaves effective.
SHARE = 0.5
MAX_STEPS = 60


def temper(
    rival: Rival,
    *,
    seed: int,
    num_particles: int = NUM_PARTICLES,
    num_moves: int = NUM_MOVES,
) -> ImportanceSample:
    r"""Return the evidence and a sample of the posterior.

    Particles go from the prior through
    :math:`p_b(z) \propto p(x | z)^b\, p(z)` to b = 1, with

    .. math::
        \log Z = \sum_k \log \frac1n \sum_i p(x | z_i)^{b_{k+1} - b_k} .

    Each step is as long as it leaves half of the particles effective, and is followed
    by random-walk and differential-evolution moves.

    Args:
        rival: The model.
        seed: Of all draws.
        num_particles: n.
        num_moves: A temperature; the two kinds take turns.

    References:
        Del Moral, Doucet & Jasra, Journal of the Royal Statistical Society B 68 (2006);
        Lee & Whiteley, Biometrika 105 (2018), for the variance.
    """
    rng = np.random.default_rng(seed)
    u = rival.coordinates.sample(PRIOR_SHARE * num_particles, seed=seed)
    log_l = rival.log_likelihood(u)
    log_z, variance, b, width = 0.0, 0.0, 0.0, 2.0 / np.sqrt(rival.dim)
    ancestor = np.arange(len(u))
    for _ in range(MAX_STEPS):
        step = _step(log_l, 1 - b, SHARE * num_particles)
        log_w = step * log_l
        log_z += log_sum_exp(log_w) - np.log(len(u))
        w = np.exp(log_w - log_sum_exp(log_w))
        variance += max(len(u) * (w**2).sum() - 1, 0.0) / len(u)
        mean = w @ u
        cov = (w[:, None] * (u - mean)).T @ (u - mean)
        factor = lower_factors(cov + 1e-16 * np.eye(rival.dim))
        which = systematic(w, num_particles, rng.uniform())
        u, log_l, b = u[which], log_l[which], b + step
        ancestor = ancestor[which]
        u, log_l, width = _move(
            rival, u, log_l, min(b, 1.0), factor, width, rng, num_moves
        )
        if b >= 1 - 1e-12:
            break
    else:
        # Never reached b = 1: the likelihood has no mass where the prior has some.
        return ImportanceSample(u, np.full(len(u), 1 / len(u)), -np.inf, np.inf, 0.0)
    # The particles of a step are not independent: twice the ideal variance, or what the
    # descendants of the same ancestor share where moves hardly spread them.
    _, family = np.unique(ancestor, return_counts=True)
    shared = ((family / len(u)) ** 2).sum()
    error = float(np.sqrt(max(2 * variance, shared)))
    weights = np.full(len(u), 1 / len(u))
    distinct = float(len(np.unique(u[:, 0])))
    return ImportanceSample(u, weights, float(log_z), error, distinct)


def _step(log_l: Array, most: float, target: float) -> float:
    """Return the longest step of b that leaves so many particles effective."""

    def suffices(step: float) -> bool:
        return effective_sample_size(step * log_l) >= target

    return largest_power(suffices, end=most)


def _move(
    rival: Rival,
    u: Array,
    log_l: Array,
    b: float,
    factor: Array,
    width: float,
    rng: np.random.Generator,
    num_moves: int,
) -> tuple[Array, Array, float]:
    """Return moved particles, their log likelihoods, and the adapted step width."""
    n = len(u)
    log_p = rival.log_prior(u)
    for move in range(num_moves):
        walk = rng.normal(size=u.shape) @ factor.T
        if move % 2 == 0:
            new = u + width * walk
        else:
            pairs = u[rng.permutation(n)] - u[rng.permutation(n)]
            new = u + 0.8 * pairs + 1e-3 * walk
        new_p, new_l = rival.log_prior(new), np.full(n, -np.inf)
        inside = np.isfinite(new_p)
        if inside.any():
            new_l[inside] = rival.log_likelihood(new[inside])
        with np.errstate(invalid="ignore"):
            ratio = b * (new_l - log_l) + new_p - log_p
        accept = np.log(rng.uniform(size=n)) < ratio
        u = np.where(accept[:, None], new, u)
        log_l, log_p = np.where(accept, new_l, log_l), np.where(accept, new_p, log_p)
        if move % 2 == 0:
            width = float(np.clip(width * np.exp(0.5 * (accept.mean() - 0.3)), 0.05, 5))
    return u, log_l, width

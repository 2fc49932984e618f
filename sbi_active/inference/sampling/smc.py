"""Sequential Monte Carlo from a normal guess, or a prior, to a density near it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from sbi_active.arrays import Array
from sbi_active.inference.sampling.mixtures import Proposal, log_normal
from sbi_active.inference.sampling.weights import (
    effective_sample_size,
    largest_power,
    log_sum_exp,
    normalized,
    systematic,
)


@dataclass(frozen=True)
class Bridged:
    """Particles of a density.

    Attributes:
        u: Particles of equal weight, shape (n, d).
        log_likelihood: Log likelihood of each particle, shape (n,).
        log_evidence: Log of the integral of the density, nats.
        standard_error: Standard error of log_evidence.
        effective_sample_size: Effective number of the particles, by families and what
            moves forgot.
        acceptance: Acceptance rate of the last moves.
        memory: Largest correlation with where the moves of a step began; those of the
            last may end sooner, where its particles share little.
        num_steps: Number of steps between the two densities.
        num_evaluations: Number of likelihoods.
    """

    u: Array
    log_likelihood: Array
    log_evidence: float
    standard_error: float
    effective_sample_size: float
    acceptance: float
    memory: float
    num_steps: int
    num_evaluations: int


def bridge(
    log_prior: Callable[[Array], Array],
    log_likelihood: Callable[[Array], Array],
    guess: Proposal,
    rng: np.random.Generator,
    *,
    num_particles: int,
    most: float = np.inf,
    moves: Moves | None = None,
    max_moves: int = 100,
    forgotten: float = 0.05,
    max_steps: int = 200,
    shared_least: float = 0.1,
) -> Bridged | None:
    r"""Return particles of :math:`p(u) L(u)`, or None if it takes too many moves.

    They go from the guess q along

    .. math::
        \pi_b(u) \propto q(u)^{1 - b}\, \bigl(p(u)\, L(u)\bigr)^b, \qquad
        \log Z = \sum_k \log \frac1n \sum_i
        \Bigl(\frac{p L}{q}\Bigr)^{b_{k+1} - b_k}(u_i),

    and are moved at each step. Where q is close, one step suffices.

    Args:
        log_prior: Log p, (n, d) -> (n,).
        log_likelihood: Log L, (n, d) -> (n,); -inf allowed.
        guess: q.
        rng: Source of randomness.
        num_particles: Number of particles n.
        most: Evaluations of the likelihood at most.
        moves: Proposals; None takes :class:`NormalMoves`.
        max_moves: A step.
        forgotten: Correlation with where they were that ends the moves of a step. At
            half the evidence is not known better; at .5 particles lag behind, and in 20
            dimensions the log evidence is off by twenty times its error.
        max_steps: Number of steps at most.
        shared_least: Share of the particles after the last step, lost to copies, beyond
            which there are more moves.

    References:
        Del Moral, Doucet & Jasra, J. R. Stat. Soc. B 68 (2006); Cotter, Roberts, Stuart
        & White, Statistical Science 28 (2013); Rudolf & Sprungk, Found. Comput. Math.
        18 (2018), for the proposal.
    """

    def densities(u: Array) -> tuple[Array, Array]:
        own = log_prior(u)
        inside = np.isfinite(own)
        log_l = np.full(len(u), -np.inf)
        if inside.any():
            log_l[inside] = log_likelihood(u[inside])
        return own + log_l, guess.log_prob(u)

    n = num_particles
    u = guess.sample(n, rng)
    target, start = densities(u)
    moves = NormalMoves(u) if moves is None else moves
    log_z = variance = b = memory = 0.0
    spent = n
    acceptance = 1.0
    step = 0
    while step < max_steps:
        step += 1
        ratio = target - start
        with np.errstate(invalid="ignore"):
            ratio = np.where(np.isfinite(target), ratio, -np.inf)
        if not np.isfinite(ratio).any():
            return None
        power = _power(ratio, b, n)
        log_w = (power - b) * np.where(np.isfinite(ratio), ratio, -np.inf)
        log_z += float(log_sum_exp(log_w) - np.log(n))
        weight = normalized(log_w)
        variance += max(n * float((weight**2).sum()) - 1, 0.0) / n
        moves.begin(u, weight, power)
        which = systematic(weight, n, rng.random())
        family = np.bincount(which, minlength=n)
        shared = float((family.astype(float) ** 2).sum() / n - 1)
        u, target, start, b = u[which], target[which], start[which], power
        kept = 1.0
        for _ in range(max_moves):
            # All particles of the last step count, but for what they share.
            if kept <= forgotten or (b == 1 and kept**2 * shared <= shared_least):
                break
            new, gain = moves.propose(u, rng)
            new_target, new_start = densities(new)
            spent += n
            with np.errstate(invalid="ignore"):
                gain = gain + b * (new_target - target)
                if b < 1:
                    gain = gain + (1 - b) * (new_start - start)
            accept = np.log(rng.random(n)) < np.where(np.isnan(gain), -np.inf, gain)
            before, u = u, np.where(accept[:, None], new, u)
            target = np.where(accept, new_target, target)
            start = np.where(accept, new_start, start)
            acceptance = float(accept.mean())
            kept *= moves.remembered(before, u, acceptance)
            if spent > most:
                break
        if spent > most and b < 1:
            return None
        memory = max(memory, kept if b < 1 or kept**2 * shared > shared_least else 0.0)
        if b == 1:
            break
    else:
        return None
    effective = n / (1 + kept**2 * shared)
    log_l = target - log_prior(u)
    error = float(np.sqrt(2 * variance + 1e-12))
    known = log_l, log_z, error, effective, acceptance, memory
    return Bridged(u, *known, num_steps=step, num_evaluations=spent)


class Moves(Protocol):
    """Proposals of sequential Monte Carlo, reversible under a density of their own."""

    def begin(self, u: Array, weight: Array, power: float) -> None:
        """Prepare the moves of a step.

        Args:
            u: Particles, shape (n, d).
            weight: Weights of the particles at this step, which sum to 1, shape (n,).
            power: Power of the target at this step.
        """
        ...

    def propose(self, u: Array, rng: np.random.Generator) -> tuple[Array, Array]:
        """Return proposed particles (n, d), and the log ratio of own densities.

        The ratio is the density where they are over that where they go, shape (n,).
        """
        ...

    def remembered(self, before: Array, after: Array, acceptance: float) -> float:
        """Return the correlation across a move, and adapt to its acceptance.

        Args:
            before: Particles, shape (n, d).
            after: Particles after it, shape (n, d).
            acceptance: Share of them that moved.
        """
        ...


class NormalMoves:
    r"""Moves that a normal N(m, C) of the particles' moments is invariant to.

    .. math::
        u' = m + \sqrt{1 - s^2}\,(u - m) + s\, C^{1/2} e,

    so that on a normal density each is accepted and none costs more in more dimensions.

    Args:
        start: Particles of the first density, shape (n, d).
        accepted: Share of moves that the step's length is adapted to (a choice).
        shrunk: Share of the first covariance in that of the particles (a choice).
    """

    def __init__(
        self, start: Array, *, accepted: float = 0.35, shrunk: float = 0.05
    ) -> None:
        self._guessed, self._length = np.atleast_2d(np.cov(start.T)), 1.0
        self._accepted, self._shrunk = accepted, shrunk

    def begin(self, u: Array, weight: Array, power: float) -> None:
        """Take the moments of weighted particles."""
        self._mean = weight @ u
        off = u - self._mean
        cov, guessed = (weight[:, None] * off).T @ off, self._guessed
        share, size = self._shrunk, min(1.0, _size(cov, guessed))
        cov = (1 - share) * cov + share * guessed * size
        self._factor = np.linalg.cholesky(cov + 1e-14 * np.eye(u.shape[1]))

    def propose(self, u: Array, rng: np.random.Generator) -> tuple[Array, Array]:
        """Return proposed particles, and the log ratio of the normal densities."""
        mean, factor, length = self._mean, self._factor, self._length
        new = mean + np.sqrt(1 - length**2) * (u - mean)
        new = new + length * rng.standard_normal(u.shape) @ factor.T
        return new, log_normal(u, mean, factor) - log_normal(new, mean, factor)

    def remembered(self, before: Array, after: Array, acceptance: float) -> float:
        """Return the correlation across a move, and adapt its length."""
        kept = 1 - acceptance * (1 - np.sqrt(1 - self._length**2))
        length = self._length * np.exp(acceptance - self._accepted)
        self._length = float(np.clip(length, 0.02, 1.0))
        return float(kept)


def _power(ratio: Array, b: float, num: int, *, share: float = 0.5) -> float:
    """Return the next b; rows without a likelihood go at the first step."""

    def suffices(candidate: float) -> bool:
        alive = min(share, 0.5 * np.isfinite(ratio).mean())
        return effective_sample_size((candidate - b) * ratio) >= alive * num

    return largest_power(suffices, start=b, num_steps=30, least=1e-6)


def _size(cov: Array, other: Array) -> float:
    """Return the ratio of two covariances' volumes, a dimension."""
    dim = len(cov)
    logs = np.linalg.slogdet(cov + 1e-14 * np.eye(dim))[1] - np.linalg.slogdet(other)[1]
    return float(np.exp(logs / dim))

r"""The belief over sources by sequential Monte Carlo on the exact likelihood.

Equally weighted particles of :math:`p(\theta) \prod_{s<t} p(x_s | \theta, \xi_s)` are
brought to the next trial by tempering,

.. math::
    p(\theta) \prod_{s<t} p(x_s | \theta, \xi_s)\; p(x_t | \theta, \xi_t)^\beta, \qquad
    0 = \beta_0 < \beta_1 < \ldots = 1,

each step the largest that leaves half of them effective; they are resampled and moved
by differences of other particles, which follow the shape of the posterior. The product
of the mean weights estimates the evidence.

It needs the likelihood, which the library's methods do not: it is here as a check of
the refined belief, and as the belief of a myopic policy that costs little.

References:
    Chopin, Biometrika 2002; Del Moral, Doucet & Jasra, JRSS B 2006 (sequential Monte
    Carlo); Jasra et al., Scand. J. Stat. 2011 (adaptive tempering); ter Braak,
    Statistics and Computing 2006 (differential evolution moves).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from benchmarks.location_finding.bounds import history_log_likelihood
from sbi_active.inference import Belief
from sbi_active.tasks import Task

EFFECTIVE = 0.5  # share of the particles, in a step
NUM_SWEEPS = 12  # of moves, a step
SCALES = (0.05, 1.2)  # of differences, between which moves are log-uniform


class ParticleBelief(Belief):
    """Particles of the posterior after some trials.

    Args:
        task: Location finding, with any number of sources.
        num_particles: N; even.
        seed: Of the draws and moves.

    Attributes:
        theta: Shape (N, 2 K), float64.
        log_evidence: Estimate of log p(h), nats.
    """

    label = "particles, exact likelihood"

    def __init__(self, task: Task, *, num_particles: int = 2_000, seed: int) -> None:
        if num_particles < 100 or num_particles % 2:
            raise ValueError(
                f"expected an even num_particles >= 100; got {num_particles}; use "
                "about 2000"
            )
        super().__init__(task.prior)
        self._generator = torch.Generator().manual_seed(seed)
        dim = self.event_shape[0]
        self.theta = self._normal(num_particles, dim)
        self.log_evidence = 0.0
        self._log_likelihood = torch.zeros(num_particles, dtype=torch.float64)
        self._action, self._x = torch.empty(0, 2), torch.empty(0, 1)

    def update(self, action: Tensor, x: Tensor) -> None:
        """Take a trial into the belief.

        Args:
            action: Shape (2,).
            x: Shape (1,).
        """
        self._action = torch.cat([self._action, action[None]])
        self._x = torch.cat([self._x, x[None]])
        new = self._new(self.theta)
        power, num = 0.0, len(self.theta)
        while power < 1:
            step = _largest_step(new, 1 - power)
            log_weight = step * new
            self.log_evidence += float(log_weight.logsumexp(0)) - math.log(num)
            rows = self._systematic(log_weight.softmax(0))
            self.theta, new = self.theta[rows], new[rows]
            self._log_likelihood = self._log_likelihood[rows]
            power = 1.0 if step >= 1 - power else power + step
            for _ in range(NUM_SWEEPS):
                new = self._sweep(new, power)
        self._log_likelihood = self._log_likelihood + new

    def _new(self, theta: Tensor) -> Tensor:
        """Return the last trial's log likelihood, shape (n,)."""
        return history_log_likelihood(theta, self._action[-1:], self._x[-1:])

    def _sweep(self, new: Tensor, power: float) -> Tensor:
        """Move all particles once; return their log likelihood of the last trial."""
        num, dim = self.theta.shape
        shuffled = torch.randperm(num, generator=self._generator)
        for own, others in (shuffled.chunk(2), shuffled.chunk(2)[::-1]):
            start = self.theta[own]
            pair = self._integers(len(others), (2, len(own)))
            first, second = (self.theta[others[index]] for index in pair)
            second = _nearer(first, second)
            low, high = SCALES
            scale = low * (high / low) ** self._uniform(len(own), 1)
            move = scale * (first - second) + 1e-5 * self._normal(len(own), dim)
            # one source, or all of them
            block = self._integers(dim // 2 + 1, (len(own), 1))
            source = torch.arange(dim)[None] // 2
            move = move * ((block == source) | (block == dim // 2))
            proposed = start + move
            proposed_new = self._new(proposed)
            proposed_past = history_log_likelihood(
                proposed, self._action[:-1], self._x[:-1]
            )
            log_ratio = (
                0.5 * (start.square() - proposed.square()).sum(1)
                + (proposed_past - self._log_likelihood[own])
                + power * (proposed_new - new[own])
            )
            accepted = self._uniform(len(own)).log() < log_ratio
            rows = own[accepted]
            self.theta[rows] = proposed[accepted]
            new[rows] = proposed_new[accepted]
            self._log_likelihood[rows] = proposed_past[accepted]
        # Sources are exchangeable: any order of them is as probable.
        order = self._uniform(num, dim // 2).argsort(1)[..., None].expand(-1, -1, 2)
        self.theta = self.theta.reshape(num, -1, 2).gather(1, order).reshape(num, dim)
        return new

    def _systematic(self, weight: Tensor) -> Tensor:
        num = len(weight)
        place = (torch.arange(num) + self._uniform(1)) / num
        return torch.searchsorted(weight.cumsum(0), place).clamp_max(num - 1)

    def _normal(self, *shape: int) -> Tensor:
        return torch.randn(shape, generator=self._generator, dtype=torch.float64)

    def _uniform(self, *shape: int) -> Tensor:
        return torch.rand(shape, generator=self._generator, dtype=torch.float64)

    def _integers(self, high: int, shape: tuple[int, ...]) -> Tensor:
        return torch.randint(high, shape, generator=self._generator)

    def _sample(self, num_samples: int) -> Tensor:
        num = len(self.theta)
        rounds = [torch.randperm(num) for _ in range(-(-num_samples // num))]
        return self.theta[torch.cat(rounds)[:num_samples]]

    def _log_prob(self, theta: Tensor) -> Tensor:
        log_likelihood = history_log_likelihood(theta, self._action, self._x)
        return self.prior.log_prob(theta) + log_likelihood - self.log_evidence


def _nearer(first: Tensor, second: Tensor) -> Tensor:
    """Return the second with its sources in reverse where that is nearer the first."""
    reverse = second.reshape(len(second), -1, 2).flip(1).reshape(second.shape)
    apart, apart_reverse = ((first - s).square().sum(1) for s in (second, reverse))
    return torch.where((apart_reverse < apart)[:, None], reverse, second)


def _largest_step(log_weight: Tensor, remaining: float) -> float:
    """Return the largest power that leaves enough particles effective."""

    def suffices(step: float) -> bool:
        weight = (step * log_weight).softmax(0)
        return float(1 / weight.square().sum()) >= EFFECTIVE * len(weight)

    if suffices(remaining):
        return remaining
    low, high = 0.0, remaining
    for _ in range(30):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if suffices(middle) else (low, middle)
    return max(low, 1e-9)

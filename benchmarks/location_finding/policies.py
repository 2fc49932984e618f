r"""Policies: where to measure next, given the measurements so far.

*Random* draws :math:`\xi \sim \mathcal N(0, I_2)`. *Fixed* visits the places of
``static_design.csv``, whatever is measured: those of the largest prior contrastive
bound after 600 steps of Adam (Foster et al., AISTATS 2020, arXiv:1911.00294).
*Myopic* is this library's loop: after every trial the belief is refined from all trials
by :class:`.ASBI`, and the next place is the one of greatest expected
information gain, by :class:`.InformationGainDesigner`, among candidates that
are drawn for this trial. *Myopic on particles* differs in the belief alone, which is
that of :mod:`benchmarks.location_finding.policies`.

The belief over sources by sequential Monte Carlo on the exact likelihood.

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
from abc import ABC, abstractmethod
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.distributions import Distribution
from typing_extensions import override

from benchmarks.location_finding.bounds import history_log_likelihood
from benchmarks.rows import column, read
from sbi_active import ASBI, DiscreteActions, InformationGainDesigner
from sbi_active.inference import Belief
from sbi_active.seeding import derive_seed, forked_generators
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


class Policy(ABC):
    """Chooses places in one roll-out.

    Args:
        task: With its simulator and prior; the truth is not looked at.
        seed: Of everything random in the policy.
    """

    def __init__(self, task: Task, seed: int) -> None:
        self.task, self.seed = task, seed
        self.action, self.x = torch.empty(0, 2), torch.empty(0, 1)

    @abstractmethod
    def choose(self) -> Tensor:
        """Return the next place, shape (2,)."""

    def tell(self, action: Tensor, x: Tensor) -> None:
        """Take note of a measurement, shapes (2,) and (1,)."""
        self.action = torch.cat([self.action, action[None]])
        self.x = torch.cat([self.x, x[None]])


class Random(Policy):
    """Standard normal places."""

    @override
    def choose(self) -> Tensor:
        seed = derive_seed(self.seed, "place", len(self.action))
        return torch.randn(2, generator=torch.Generator().manual_seed(seed))


class Fixed(Policy):
    """The optimized static design, place by place."""

    def __init__(self, task: Task, seed: int) -> None:
        super().__init__(task, seed)
        rows = read(Path(__file__).with_name("static_design.csv"))
        places = [column(rows, name) for name in ("place_x", "place_y")]
        self.places = torch.tensor(np.stack(places, 1)).float()

    @override
    def choose(self) -> Tensor:
        index = len(self.action)
        if index >= len(self.places):
            raise ValueError(
                f"expected at most {len(self.places)} trials, the static design's; got "
                f"trial {index + 1}; optimize one for more trials"
            )
        return self.places[index]


class Myopic(Policy):
    """The greatest expected information gain of the next trial alone.

    Args:
        task: As for any policy.
        seed: As for any policy.
        num_candidates: Places to compare in a trial.
        num_samples: Simulations a candidate on average.

    Attributes:
        belief: Given all measurements so far.
        num_simulations: Of designs and belief so far.
    """

    belief: Distribution

    def __init__(
        self,
        task: Task,
        seed: int,
        *,
        num_candidates: int = 64,
        num_samples: int = 240,
    ) -> None:
        super().__init__(task, seed)
        self.num_candidates, self.num_samples = num_candidates, num_samples
        self.num_simulations = 0
        self._inference = ASBI(task.prior, show_progress_bars=False)
        self.belief = task.prior

    @override
    def choose(self) -> Tensor:
        seed = derive_seed(self.seed, "design", len(self.action))
        places = candidates(self.belief, self.num_candidates, seed)
        designer = InformationGainDesigner(
            DiscreteActions(places), num_samples=self.num_samples
        )
        design = designer.select(
            None, self.task.simulator, belief=self.belief, seed=seed
        )
        self.num_simulations += design.num_simulations
        return design.action

    @override
    def tell(self, action: Tensor, x: Tensor) -> None:
        super().tell(action, x)
        self.belief = self._inference.update(
            x,
            action=action,
            simulator=self.task.simulator,
            seed=derive_seed(self.seed, "update", len(self.action)),
        )
        self.num_simulations += self.belief.diagnostics.num_simulations


class MyopicParticles(Myopic):
    """The same with a belief by sequential Monte Carlo on the exact likelihood."""

    def __init__(self, task: Task, seed: int, **options: int) -> None:
        super().__init__(task, seed, **options)
        particle_seed = derive_seed(seed, "particles")
        self._particles = ParticleBelief(task, seed=particle_seed)
        self.belief = self._particles

    @override
    def tell(self, action: Tensor, x: Tensor) -> None:
        Policy.tell(self, action, x)
        self._particles.update(action, x)


POLICIES: dict[str, type[Policy]] = {
    "random": Random,
    "fixed": Fixed,
    "myopic": Myopic,
    "myopic_particles": MyopicParticles,
}


def candidates(belief: Distribution, num_candidates: int, seed: int) -> Tensor:
    """Return places to compare, shape (num_candidates, 2).

    Half are sources of draws of the belief, so that they crowd where a source may be
    and are as far apart as its place is uncertain. A quarter lie beside such sources,
    in the direction from a nearby source of another draw and up to twice as far. A
    quarter are normal with a standard deviation of 1.5, for the rest of the plane.

    Args:
        belief: Over the sources.
        num_candidates: Number of places.
        seed: Of the draws.
    """
    num_beside = num_anywhere = num_candidates // 4
    num_sources = num_candidates - num_beside - num_anywhere
    with forked_generators(seed, "candidates"):
        source = _sources(belief, num_sources + num_beside)
        at, center = source[:num_sources], source[num_sources:]
        other = _sources(belief, 64)
        nearest = torch.cdist(center, other).topk(16, largest=False).indices
        pick = nearest[torch.arange(num_beside), torch.randint(16, (num_beside,))]
        step = center - other[pick]
        beside = center + 2 * torch.rand(num_beside, 1) * step
        anywhere = 1.5 * torch.randn(num_anywhere, 2)
    return torch.cat([at, beside, anywhere])


def _sources(belief: Distribution, num: int) -> Tensor:
    """Return a source of each of num draws, shape (num, 2)."""
    theta = belief.sample(torch.Size([num])).reshape(num, -1, 2)
    return theta[torch.arange(num), torch.randint(theta.shape[1], (num,))]

r"""Policies: where to measure next, given the measurements so far.

*Random* draws :math:`\xi \sim \mathcal N(0, I_2)`. *Fixed* visits the places of one
static design (:mod:`benchmarks.location_finding.static_design`), whatever is measured.
*Myopic* is this library's loop: after every trial the belief is refined from all trials
by :class:`.ASBI`, and the next place is the one of greatest expected
information gain, by :class:`.InformationGainDesigner`, among candidates that
are drawn for this trial. *Myopic on particles* differs in the belief alone, which is
that of :mod:`benchmarks.location_finding.particles`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod

import torch
from torch import Tensor
from torch.distributions import Distribution
from typing_extensions import override

from benchmarks.location_finding.particles import ParticleBelief
from benchmarks.location_finding.static_design import load
from sbi_active import ASBI, DiscreteActions, InformationGainDesigner
from sbi_active.seeding import derive_seed, forked_generators
from sbi_active.tasks import Task


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
        self.places = load()

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

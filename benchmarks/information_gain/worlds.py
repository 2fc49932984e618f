"""Rounds of the numerical task as pyro's models, with their exact gains."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor
from torch.distributions import Distribution
from torch.distributions.constraints import real_vector

from benchmarks.information_gain.guides import Pilot
from benchmarks.information_gain.run import rounds
from sbi_active.tasks import Task

POOL = 200_000  # draws that stand in for the belief of round 2
NUM_PILOT = 1_000  # simulations an action that standardize the outcomes


class Pool(Distribution):
    """Draws in place of a distribution.

    Args:
        draws: Shape (m, theta_dim).
    """

    def __init__(self, draws: Tensor) -> None:
        super().__init__(torch.Size(), draws.shape[1:], validate_args=False)
        self.draws = draws

    @property
    def support(self) -> Any:
        return real_vector

    def sample(self, sample_shape: Any = ()) -> Tensor:
        return self.draws[torch.randint(len(self.draws), torch.Size(sample_shape))]


class Drawn(dist.TorchDistribution):
    """A belief as a site of pyro's model; no estimator here asks for its density."""

    def __init__(self, belief: Distribution, batch_shape: torch.Size) -> None:
        self.belief = belief
        super().__init__(batch_shape, belief.event_shape, validate_args=False)

    @property
    def support(self) -> Any:
        return real_vector

    def sample(self, sample_shape: Any = ()) -> Tensor:
        return self.belief.sample(torch.Size(sample_shape) + self.batch_shape)

    def log_prob(self, value: Tensor) -> Tensor:
        return torch.zeros(value.shape[:-1])


@dataclass(frozen=True)
class World:
    """One round of the task.

    Attributes:
        name: Of the round.
        task: With its actions.
        belief: To draw parameters from.
        entropy: Of the belief, exact, nats; pyro is told it.
        exact: Gains, shape (a,).
    """

    name: str
    task: Task
    belief: Distribution
    entropy: float
    exact: Tensor

    def model(self, design: Tensor) -> None:
        """Pyro's model; designs of shape (..., a, 1)."""
        theta = pyro.sample("theta", Drawn(self.belief, design.shape[:-1]))
        rows = theta.reshape(-1, 2), design.reshape(-1, 1)
        mean = self.task.simulator.mean(*rows).reshape(design.shape)
        pyro.sample("x", dist.Normal(mean, 1.0).to_event(1))

    def pilot(self) -> Pilot:
        """Return simulations that standardize outcomes."""
        theta = self.belief.sample(torch.Size([NUM_PILOT]))
        actions = self.task.actions.values
        x = [self.task.simulator(theta, a.expand(NUM_PILOT, -1)) for a in actions]
        return Pilot.of(theta, torch.stack(x))


def worlds() -> list[World]:
    """Return the cases."""
    cases = []
    for variant in ("linear", "sinh"):
        task, before, after = rounds(variant)
        gain = before.expected_information_gain(task.actions.values)
        name = f"{variant}, round 1"
        cases.append(World(name, task, task.prior, 2 * math.log(10), gain))
        if variant == "linear":
            draws = after.sample(POOL, seed=0)
            entropy = -float(after.log_prob(draws).mean())
            gain = after.expected_information_gain(task.actions.values)
            cases.append(
                World("linear, round 2", task, Pool(draws.float()), entropy, gain)
            )
    return cases

"""Trials whose index matters to the simulator, such as under a drift."""

from __future__ import annotations

import copy
import uuid
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.actions import ActionSpace
from sbi_active.seeding import derive_seed, forked_generators
from sbi_active.simulation import simulate


def at_index(simulator: Any, index: int) -> Any:
    """Return the simulator of one trial.

    Args:
        simulator: Simulator with a ``next_index``; any other is returned as it is.
        index: Index of the trial.
    """
    if getattr(simulator, "next_index", index) == index:
        return simulator
    twin = copy.copy(simulator)
    twin.next_index = index
    twin._token = uuid.uuid4().hex  # workers keep simulators by it
    return twin


def depends_on_index(
    simulator: Any, prior: Distribution, actions: ActionSpace, *, seed: int
) -> bool:
    """Return whether x changes with the index of the trial at the same seeds."""
    if not hasattr(simulator, "next_index"):
        return False
    with forked_generators(seed, "theta"):
        theta = prior.sample(torch.Size([16]))
    action = actions.sample((16,), seed=derive_seed(seed, "action"))
    first, second = (
        simulate(at_index(simulator, i), theta, action, seed=derive_seed(seed, "x")).x
        for i in (0, 7)
    )
    return not torch.allclose(first, second, equal_nan=True)


class IndexedSimulator:
    """A simulator whose action carries the index of the trial as a last entry.

    Args:
        simulator: Simulator with a ``next_index``.
    """

    def __init__(self, simulator: Any) -> None:
        self.simulator = simulator

    def __call__(self, theta: Tensor, action: Tensor) -> Tensor:
        """Return draws, rows of each index by the simulator of that trial."""
        index = action[:, -1]
        order, parts = [], []
        for value in index.unique():
            rows = torch.nonzero(index == value)[:, 0]
            simulator = at_index(self.simulator, int(value))
            parts.append(simulator(theta[rows], action[rows, :-1]))
            order.append(rows)
        return torch.cat(parts)[torch.argsort(torch.cat(order))]

"""The interface of every action space."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from sbi_active.expected import require


class ActionSpace(ABC):
    """A set of actions that can be sampled and tested for membership.

    Attributes:
        names: Names of the entries of the action.
        units: Units of the entries of the action; empty if unknown.
    """

    names: list[str]
    units: list[str]

    @property
    @abstractmethod
    def action_dim(self) -> int:
        """Numbers in an action."""

    @abstractmethod
    def sample(self, sample_shape: Sequence[int], *, seed: int | None = None) -> Tensor:
        """Return uniform draws.

        Args:
            sample_shape: Shape of the draws, any, as in torch's distributions.
            seed: Seed of the draws; None uses torch's global generator.

        Returns:
            Shape (*sample_shape, action_dim).
        """

    @abstractmethod
    def contains(self, action: Tensor) -> Tensor:
        """Return which actions belong to the space.

        Args:
            action: Actions, shape (..., action_dim).

        Returns:
            Shape (...), bool.
        """

    def permits(self, action: Tensor) -> Tensor:
        """Return which actions keep limits beyond those of their entries.

        Args:
            action: Actions within the limits of each entry, shape (n, action_dim).

        Returns:
            Shape (n,), bool.
        """
        return torch.ones(len(action)).bool()

    def listed(self) -> Tensor | None:
        """Return all actions, shape (a, action_dim); None if there is no end."""
        return None

    @property
    def entry_labels(self) -> tuple[str, ...]:
        """Names of the entries of the action with their units, as "speed [m/s]"."""
        pairs = zip(self.names, self.units, strict=True)
        return tuple(f"{name} [{unit}]" if unit else name for name, unit in pairs)

    def parts(self) -> list[ActionSpace]:
        """Return the spaces that this one is the product of."""
        return [self]

    def entries(self) -> Iterator[tuple[ActionSpace, slice]]:
        """Yield each part with its entries of an action."""
        begin = 0
        for part in self.parts():
            yield part, slice(begin, begin + part.action_dim)
            begin += part.action_dim

    def _label(self, names: Sequence[str] | None, units: Sequence[str] | None) -> None:
        dim = self.action_dim
        default = ["action"] if dim == 1 else [f"action_{i + 1}" for i in range(dim)]
        self.names = default if names is None else [*names]
        self.units = [""] * dim if units is None else [*units]
        expected = f"{dim} names and units, one an entry of the action"
        got, fits = f"{self.names} and {self.units}", len(self.names) == dim
        require(fits and len(self.units) == dim, expected, got, "give one each")

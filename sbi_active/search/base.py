"""Interface of a search."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from sbi_active.actions import ActionSpace


@dataclass(frozen=True)
class Evaluations:
    """Estimates of the utility.

    Attributes:
        action: Actions, shape (n, action_dim).
        utility: Expected information gain, by its cost where there is one, shape (n,).
        standard_error: Standard errors, shape (n,).
        probability_valid: Share of simulations with a measurement, shape (n,).
    """

    action: Tensor
    utility: Tensor
    standard_error: Tensor
    probability_valid: Tensor

    def join(self, other: Evaluations) -> Evaluations:
        """Return these and others."""
        return Evaluations(
            *(torch.cat([a, b]) for a, b in zip(self._all(), other._all(), strict=True))
        )

    def known(self) -> Evaluations:
        """Return the evaluations that are numbers."""
        keep = self.utility.isfinite() & self.standard_error.isfinite()
        return Evaluations(*(part[keep] for part in self._all()))

    def _all(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        return self.action, self.utility, self.standard_error, self.probability_valid


@dataclass(frozen=True)
class Objective:
    """The utility that a search maximizes.

    Attributes:
        actions: The space.
        permitted: Function of actions (n, action_dim) that says which may be chosen,
            shape (n,), bool.
        evaluate: Function that simulates actions (k, action_dim), all at the same
            parameters, also from call to call.
        num_evaluations: Actions that may be evaluated.
        seed: Seed of the search's draws.
        min_probability_valid: Share of measurements that a choice needs.
        known: Evaluations to begin with; None for none.
    """

    actions: ActionSpace
    permitted: Callable[[Tensor], Tensor]
    evaluate: Callable[[Tensor], Evaluations]
    num_evaluations: int
    seed: int
    min_probability_valid: float = 0.0
    known: Evaluations | None = None


class Search(ABC):
    """Find the actions that deserve an estimate on many simulations."""

    @abstractmethod
    def size(self, actions: ActionSpace) -> int:
        """Return the simulations of a design, in those of one candidate.

        Raises:
            TypeError: If the search does not apply to the space.
        """

    @abstractmethod
    def num_evaluations(self, budget: int, num_samples: int) -> int:
        """Return the number of actions to evaluate on the way.

        Args:
            budget: Simulations of the design.
            num_samples: Simulations of an evaluation.

        Raises:
            ValueError: If the budget does not suffice.
        """

    @abstractmethod
    def finalists(self, objective: Objective) -> Tensor:
        """Return actions, shape (a, action_dim), the best of which is then chosen."""

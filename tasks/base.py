"""What a task offers."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, Protocol

import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.actions import DiscreteActions
from sbi_active.seeding import forked_generators
from sbi_active.simulation import SimulatorModel, simulate

__all__ = ["Reference", "Task"]


class Reference(Protocol):
    """Exact inference, where a task has it."""

    def log_prob(self, theta: Tensor) -> Tensor:
        """Return the exact log posterior density, (n, theta_dim) -> (n,)."""
        ...

    def expected_information_gain(self, action: Tensor) -> Tensor:
        """Return the exact gain of a further trial, (a, action_dim) -> (a,), nats."""
        ...


class Task(ABC):
    """A benchmark problem with a known truth.

    Attributes:
        name: As in ``get_task``.
        prior: Over the parameters.
        actions: The default action space.
        simulator: With its noise.
        theta_true: Parameters of the real system, shape (theta_dim,); NaN where it is
            no point of the model.
    """

    name: str
    prior: Distribution
    actions: DiscreteActions
    simulator: SimulatorModel
    theta_true: Tensor

    def __repr__(self) -> str:
        return (
            f"{type(self).__name__}({', '.join(self.parameter_names)}; {self.actions})"
        )

    @property
    def parameter_names(self) -> list[str]:
        """One name a parameter."""
        names = self.simulator.parameter_names
        return (
            [f"theta_{i + 1}" for i in range(len(self.theta_true))]
            if (names is None)
            else names
        )

    def real_system(self, action: Tensor, *, seed: int | None = None) -> Tensor:
        """Execute one action on the real system.

        Args:
            action: Shape (action_dim,).
            seed: Of the measurement; None draws from torch's global generator.

        Returns:
            The outcome, shape x_shape.
        """
        seed = int(torch.randint(2**62, ())) if seed is None else seed
        rows = simulate(
            self.simulator, self.theta_true[None], action.reshape(1, -1), seed=seed
        )
        return rows.x[0]

    def reproduction_error(
        self,
        belief: Distribution,
        action: Tensor | float,
        *,
        num_samples: int = 100_000,
        seed: int = 0,
    ) -> float:
        r"""Return how far the tuned simulator is from the real system at an action.

        .. math::
            \mathrm{RepErr}(\xi) = \frac{1}{N} \sum_i
            \| f_\xi(\theta_i) - f_\xi(\theta^{\mathrm{true}}) \|, \quad \theta_i \sim b

        Args:
            belief: Any distribution over the parameters.
            action: Shape (action_dim,), or a number.
            num_samples: Draws N.
            seed: Of the draws.
        """
        with forked_generators(seed, "reproduction"):
            theta = belief.sample((num_samples,))
        row = torch.as_tensor(action, dtype=torch.float32).reshape(1, -1)
        output = self.simulator.mean(theta, row.expand(len(theta), -1))
        truth = self.simulator.mean(self.theta_true[None], row)
        return float((output - truth).flatten(1).double().norm(dim=1).mean())

    def with_truth(self, theta_true: Sequence[float] | Tensor) -> Task:
        """Return the same task with another truth."""
        return type(self)(**{**self._options(), "theta_true": theta_true})

    @abstractmethod
    def _options(self) -> dict[str, Any]:
        """Return the options that make this task again."""

    def reference(self, action: Tensor, x: Tensor) -> Reference | None:
        """Return exact inference from trials, or None where there is none.

        Args:
            action: Shape (t, action_dim).
            x: Shape (t, *x_shape).
        """
        return None

"""What an active inference method offers, whatever it learns."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol, runtime_checkable

from torch import Tensor
from torch.distributions import Distribution
from typing_extensions import Self

from sbi_active.inference.beliefs.belief import Belief
from sbi_active.inference.refinement.stages import Refinement
from sbi_active.inference.rounds.rows import Observation

__all__ = ["ActiveInference"]


@runtime_checkable
class ActiveInference(Protocol):
    r"""A method that learns from simulations and updates a belief by real trials.

    A round: rows drawn under the current belief are appended, something is trained on
    them, :meth:`build_posterior` gives the model that actions are designed with, and
    :meth:`update` takes the real trial. The model has ``log_posterior``,
    ``log_likelihood`` or ``log_ratio``, which is all that a designer asks for.

    Attributes:
        trials: Real trials so far, in order.
    """

    trials: list[Observation]

    @property
    def belief(self) -> Distribution | None:
        """The current belief over parameters; the prior before any trial."""
        ...

    def arrange(self, theta: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """Return the rows to simulate in a round, made of independent draws.

        Args:
            theta: Draws from the belief, shape (n, theta_dim).
            action: Draws from the action space, shape (n, action_dim).

        Returns:
            At most n rows of both; most methods take the draws as they are.
        """
        ...

    def append_simulations(
        self,
        theta: Tensor,
        x: Tensor,
        *,
        action: Tensor | None = None,
        belief: Distribution | None = None,
    ) -> Self:
        """Store simulations of this round.

        Args:
            theta: Drawn from the belief, shape (n, theta_dim).
            x: Outcomes, shape (n, *x_shape); NaN where there was no measurement.
            action: Shape (n, action_dim).
            belief: The distribution of theta; None is the current belief.
        """
        ...

    def train(self) -> Any:
        """Learn from this round's rows."""
        ...

    def build_posterior(self) -> Any:
        """Return the model of this round."""
        ...

    def update(
        self,
        x_o: Tensor,
        *,
        action: Tensor,
        simulator: Callable[..., Any] | None = None,
        refinement: Refinement | None = None,
        seed: int | None = None,
    ) -> Belief:
        """Return the belief after a real trial, and make it the current one.

        Args:
            x_o: The outcome, shape x_shape or (1, *x_shape).
            action: The executed action, shape (action_dim,) or (1, action_dim).
            simulator: To refine the belief with.
            refinement: Budget of that.
            seed: Of everything random here; None draws one from torch's global
                generator.
        """
        ...

    def update_all(
        self,
        trials: Sequence[Observation],
        simulator: Callable[..., Any],
        *,
        refinement: Refinement | None = None,
        seed: int | None = None,
    ) -> Belief:
        """Return the belief of these trials alone, computed from scratch."""
        ...

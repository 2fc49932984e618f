"""The posterior over parameters given an outcome and the action that led to it."""

from __future__ import annotations

from copy import deepcopy
from typing import Any

import torch
from sbi.inference.posteriors.base_posterior import NeuralPosterior
from sbi.inference.posteriors.direct_posterior import DirectPosterior
from sbi.neural_nets.estimators.base import ConditionalDensityEstimator
from sbi.sbi_types import Shape
from torch import Tensor, nn

from sbi_active.inference.condition import action_rows, outcome_rows, pack

__all__ = ["ActionPosterior"]


class ActionPosterior:
    r"""Amortized posterior :math:`q(\theta | x, \xi)`.

    It has the methods of sbi's posteriors with ``x=`` and ``action=`` together. What
    only knows a posterior over x takes :meth:`at`, and one over packed (x, action)
    takes :meth:`packed`.

    Args:
        packed: sbi's posterior over packed conditions.
        x_shape: Shape of one outcome.
        action_dim: Numbers in an action.

    Attributes:
        belief: The belief the estimator was trained under.
    """

    def __init__(
        self, packed: NeuralPosterior, x_shape: torch.Size, action_dim: int
    ) -> None:
        self._packed = packed
        self.x_shape = torch.Size(x_shape)
        self.action_dim = action_dim
        self.belief = packed.prior if isinstance(packed, DirectPosterior) else None

    def __repr__(self) -> str:
        return (
            f"ActionPosterior(x {tuple(self.x_shape)}, action ({self.action_dim},), "
            f"{type(self._packed).__name__})"
        )

    def sample(
        self,
        sample_shape: Shape = (),
        x: Tensor | None = None,
        action: Tensor | None = None,
        **kwargs: Any,
    ) -> Tensor:
        """Return draws given one outcome.

        Args:
            sample_shape: Any shape.
            x: The outcome, shape x_shape or (1, *x_shape).
            action: The action that led to it, shape (action_dim,) or (1, action_dim).
            kwargs: Passed to sbi's ``sample``.

        Returns:
            Shape (*sample_shape, theta_dim).

        Raises:
            ValueError: If x or action is missing or has another shape.
        """
        kwargs.setdefault("show_progress_bars", False)
        condition = self._condition(x, action)
        draws = self._packed.sample(sample_shape, x=condition, **kwargs)
        return draws.reshape(*torch.Size(sample_shape), -1)

    def sample_batched(
        self,
        sample_shape: Shape,
        x: Tensor | None = None,
        action: Tensor | None = None,
        **kwargs: Any,
    ) -> Tensor:
        """Return draws given each of several outcomes.

        Args:
            sample_shape: Any shape.
            x: Shape (b, *x_shape).
            action: Shape (b, action_dim), or (action_dim,) for all.
            kwargs: Passed to sbi's ``sample_batched``.

        Returns:
            Shape (*sample_shape, b, theta_dim).
        """
        kwargs.setdefault("show_progress_bars", False)
        condition = self._condition(x, action)
        return self._packed.sample_batched(sample_shape, x=condition, **kwargs)

    def log_prob(
        self,
        theta: Tensor,
        x: Tensor | None = None,
        action: Tensor | None = None,
        **kwargs: Any,
    ) -> Tensor:
        """Return the log density of parameters given one outcome.

        Args:
            theta: Shape (n, theta_dim).
            x: The outcome, shape x_shape or (1, *x_shape).
            action: The action that led to it.
            kwargs: Passed to sbi's ``log_prob``.

        Returns:
            Shape (n,); -inf outside the prior's support.
        """
        condition = self._condition(x, action)
        return self._direct().log_prob(theta.float(), x=condition, **kwargs)

    def log_prob_batched(
        self,
        theta: Tensor,
        x: Tensor | None = None,
        action: Tensor | None = None,
        **kwargs: Any,
    ) -> Tensor:
        """Return log densities given each of several outcomes.

        Args:
            theta: Shape (n, b, theta_dim).
            x: Shape (b, *x_shape).
            action: Shape (b, action_dim), or (action_dim,) for all.
            kwargs: Passed to sbi's ``log_prob_batched``.

        Returns:
            Shape (n, b).
        """
        condition = self._condition(x, action)
        return self._direct().log_prob_batched(theta.float(), x=condition, **kwargs)

    def map(
        self, x: Tensor | None = None, action: Tensor | None = None, **kwargs: Any
    ) -> Tensor:
        """Return the parameters of highest density, shape (1, theta_dim).

        Args:
            x: The outcome, shape x_shape or (1, *x_shape).
            action: The action that led to it.
            kwargs: Passed to sbi's ``map``.
        """
        condition = self._condition(x, action)
        if "init_method" not in kwargs:
            num = kwargs.get("num_init_samples", 1_000)
            kwargs["init_method"] = self.sample((num,), x=x, action=action)
        return deepcopy(self._packed).set_default_x(condition).map(**kwargs)

    def log_posterior(self, theta: Tensor, x: Tensor, action: Tensor) -> Tensor:
        r"""Return :math:`\log q(\theta_i | x_i, \xi_i)` row by row.

        Without leakage correction, which a bound on the information does not need.

        Args:
            theta: Shape (n, theta_dim).
            x: Shape (n, *x_shape); NaN where there was no measurement.
            action: Shape (n, action_dim).

        Returns:
            Shape (n,).
        """
        condition = self._condition(x, action)
        return self._direct().posterior_estimator.log_prob(
            theta[None].float(), condition
        )[0]

    def packed(self) -> NeuralPosterior:
        """Return sbi's posterior over packed (x, action), x flattened."""
        return self._packed

    def at(self, action: Tensor) -> DirectPosterior:
        """Return sbi's own posterior over x at one action, for its diagnostics.

        Args:
            action: Shape (action_dim,) or (1, action_dim).
        """
        direct = self._direct()
        row = action_rows(action, self.action_dim, num_rows=1)
        estimator = _AtAction(direct.posterior_estimator, row, self.x_shape)
        return DirectPosterior(estimator, direct.prior)

    def _direct(self) -> DirectPosterior:
        if not isinstance(self._packed, DirectPosterior):
            raise ValueError(
                "expected a posterior with a density; got one that only samples, "
                f"{type(self._packed).__name__}; do build_posterior() with "
                "sample_with='direct'"
            )
        return self._packed

    def _condition(self, x: Tensor | None, action: Tensor | None) -> Tensor:
        if x is None or action is None:
            given = "x without action" if action is None else "action without x"
            given = "neither" if x is None and action is None else given
            raise ValueError(
                f"expected x= and action= together; got {given}; do pass both, or "
                "posterior.at(action) to something that only knows x"
            )
        rows = outcome_rows(x, self.x_shape)
        return pack(rows, action_rows(action, self.action_dim, num_rows=len(rows)))


class _AtAction(ConditionalDensityEstimator):
    """A packed estimator at one action: its condition is x alone."""

    action: Tensor

    def __init__(
        self, packed: ConditionalDensityEstimator, action: Tensor, x_shape: torch.Size
    ) -> None:
        super().__init__(nn.Identity(), packed.input_shape, x_shape)
        self.packed = packed
        self.register_buffer("action", action)

    def _pack(self, x: Tensor) -> Tensor:
        rows = x.reshape(-1, *self.condition_shape)
        condition = pack(rows, self.action.expand(len(rows), -1))
        leading = x.shape[: x.ndim - len(self.condition_shape)]
        return condition.reshape(*leading, -1)

    def log_prob(self, input: Tensor, condition: Tensor, **kwargs: Any) -> Tensor:
        return self.packed.log_prob(input, self._pack(condition), **kwargs)

    def loss(self, input: Tensor, condition: Tensor, **kwargs: Any) -> Tensor:
        return self.packed.loss(input, self._pack(condition), **kwargs)

    def sample(
        self, sample_shape: torch.Size, condition: Tensor, **kwargs: Any
    ) -> Tensor:
        return self.packed.sample(sample_shape, self._pack(condition), **kwargs)
